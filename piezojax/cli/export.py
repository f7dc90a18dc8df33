"""``python -m piezojax.export FILE --out DIR``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from ..core.files import numbered_folder
from .command import RESULTS, Command, common, exit_unsafe, print_results, run
from .tune import study_path

if TYPE_CHECKING:
    from rich.table import Table

    from ..core.about import About
    from ..core.system import System
    from ..exporting.compiled_loop import Runs

SYSTEMS = ("gains.toml", "model.json")
"""Files that may hold the System of a folder of results, in order of preference."""


@click.command(cls=Command)
@click.argument("source", type=click.Path(path_type=Path), metavar="FILE")
@click.option(
    "--to",
    type=click.Choice(["c", "fmu", "mat", "octave", "biquads", "vendor"]),
    default="c",
    help="c: C99 with a test (default); fmu: FMU 2.0 for co-simulation; mat, octave: "
    "the model linearised at rest; biquads: the linear feedback as second-order "
    "sections; vendor: the file of an E727, NV200 or Stabilizer.",
)
@click.option(
    "--name",
    help="Prefix of files and C names (default: controller, or plant for a model).",
)
@click.option(
    "--precision",
    type=click.Choice(["double", "float", "compensated"]),
    default="double",
    help="Type of all real numbers in C (default: double); compensated: float with the "
    "rounding errors of sums carried along. If float adds too much error, compensated "
    "is written instead.",
)
@click.option(
    "--study",
    type=click.Path(path_type=Path),
    help="Study on whose references a controller in C is judged (default: the "
    "study.toml beside FILE).",
)
@click.option(
    "--limits",
    type=(float, float),
    multiple=True,
    metavar="LOWEST HIGHEST",
    help="Limits of the voltage, V, once for each axis (default: those of the study).",
)
@click.option(
    "--before",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="SAVED",
    help="File saved from the device, for a comparison and a backup (--to vendor).",
)
@click.option(
    "--accept-unsafe",
    is_flag=True,
    help="Export gains that have an alarm or that no study has judged; the files begin "
    "with the alarm.",
)
@common
def main(
    source, to, name, precision, study, limits, before, accept_unsafe, out, seed, quiet
):
    """Export the System in FILE as C99, an FMU, a linear model or a vendor's file.

    FILE is the gains.toml of tune, the model.json of identify, or the folder that holds
    one of them. For C, `make test` in the new folder compiles the source and replays a
    simulation. A controller in C is also compiled here and judged in the simulated loop
    of its study; report.json has its errors in double and float, and the time of a
    step.

    Exit status 3 means that this loop diverges; the files then begin with the alarm.
    """

    def body(console):
        alarms = export_file(
            source,
            console,
            to=to,
            name=name,
            precision=precision,
            study=study,
            limits=limits or None,
            before=before,
            accept_unsafe=accept_unsafe,
            out=out,
            seed=seed or 0,
        )
        exit_unsafe(alarms)

    run(quiet, body)


def export_file(
    source: Path,
    console: Console,
    *,
    to: str = "c",
    name: str | None = None,
    precision: str = "double",
    study: Path | None = None,
    limits: Sequence[tuple[float, float]] | None = None,
    before: Path | None = None,
    accept_unsafe: bool = False,
    out: Path | None = None,
    seed: int = 0,
    runs: "Runs | None" = None,
) -> list[str]:
    """Export the System in the file or folder ``source`` and print the result.

    Return the alarms of the exported controller in the simulated loop; those of its
    file are refused, or accepted by ``accept_unsafe``. ``runs`` are the runs of the
    study, which judge a controller in C; by default they are computed from the file of
    the study. The other arguments are the options of the command.
    """
    from ..core.files import read_model
    from ..core.serial import load, read_about
    from ..exporting import device_values, export, export_alarms
    from ..exporting.exporter import REPORT
    from ..exporting.judge import ExportReport
    from ..report.device_table import device_table
    from ..report.export_tables import judgement
    from ..report.page import Page, write_page

    path = next(
        (source / file for file in SYSTEMS if (source / file).is_file()), source
    )
    about = read_about(path)
    # `export` refuses alarms; its message names the option.
    system = load(path, accept_unsafe=True)
    folder = out or numbered_folder(RESULTS / f"{path.stem}_{to}")
    if to != "c":
        runs = None  # they judge only C code
    elif about.study is not None and runs is None:
        try:
            runs = _runs(study, path, about, system)
        except ValueError as error:
            if study is not None:
                raise
            console.print(
                f"note: not judged in the simulated loop: {error}; name its study "
                "(--study)",
                soft_wrap=True,
            )
    files = export(
        system,
        folder,
        to=to,
        name=name,
        about=about,
        limits=limits,
        precision=precision,
        seed=seed,
        before=before,
        accept_unsafe=accept_unsafe,
        runs=runs,
    )
    parts: "list[Table | str]" = [f"{file}" for file in files]
    if to == "vendor":
        parts.append(device_table(device_values(system, before)))
    alarms: list[str] = []
    if runs is not None:
        report = read_model(ExportReport, folder / REPORT, "is no report")
        alarms = report.alarms
        parts += judgement(report)
    if to == "c":
        parts.append(f"test: make -C {folder} test")
    page = Page(
        f"{type(system).__name__} of {path.name}, exported as {to}",
        [*export_alarms(system, about), *alarms],
        parts,
        about.origin("A System"),
    )
    write_page(page, folder)
    print_results(page, folder, console)
    return alarms


def _runs(
    named: Path | None, file: Path, about: "About", controller: "System"
) -> "Runs":
    """Return the runs of the study at ``named`` for ``controller`` with ``about``.

    ``named`` defaults to the study.toml beside the ``file`` of the controller. Raises
    ValueError if study and controller have different sampling rates, and as
    ``require_own`` for that study.toml.
    """
    from .. import study as studies
    from ..tuning.exported_runs import holdout_of, make_runs
    from ..tuning.result import STUDY_FILE, require_own

    path = study_path(named or file.with_name(STUDY_FILE))
    case = studies.read(path, about.seed)
    if case.study.rate != about.rate_Hz:
        raise ValueError(
            f"{path} is for {case.study.rate:g} Hz, the controller for "
            f"{about.rate_Hz:g} Hz"
        )
    if not named:
        require_own(case, about, file)
    return make_runs(case, holdout_of(case, controller))
