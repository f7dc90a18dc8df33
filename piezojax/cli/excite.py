"""``python -m piezojax.excite [RESULTS]``: voltages to record."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .command import Command, common, print_loading, print_results, results_folder, run
from .terminal import Bar

if TYPE_CHECKING:
    from ..study import Case

RECORD, DESIGNED = "record.csv", "designed.csv"
"""File names of a whole record, and of a designed one for a small buffer."""

SECONDS = 1.0
"""Duration of each half of a designed record, s, unless it is given."""

NEEDED = "lower", "upper", "rate"
"""Options that RESULTS replace."""


@click.command(cls=Command)
@click.argument("results", required=False, type=click.Path(path_type=Path))
@click.option("--lower", type=float, help="Lower limit, V.")
@click.option("--upper", type=float, help="Upper limit, V.")
@click.option("--rate", type=float, help="Rate of the generator, Hz.")
@click.option("--slew", type=float, help="Largest slew rate of the amplifier, V/s.")
@click.option(
    "--slowest",
    type=float,
    default=5.0,
    show_default=True,
    help="Frequency of the cycles over the whole range, Hz.",
)
@click.option(
    "--highest",
    type=float,
    help="Highest frequency of the multisine, and of the moves of a designed record, "
    "Hz (default: 0.4 of the rate).",
)
@click.option(
    "--hold",
    type=float,
    default=0.25,
    show_default=True,
    help="Time for which a level is held, s; slower creep stays unknown.",
)
@click.option(
    "--duration",
    type=click.FloatRange(min=0.0, min_open=True),
    help=f"Duration of each half of a designed record, s (default: {SECONDS:g}).",
)
@click.option(
    "--points",
    type=click.IntRange(min=1),
    help="Size of the generator's buffer: write a file for each part, with at most "
    "this number of points, instead of one record.",
)
@common
def main(results, duration, points, out, seed, quiet, **limits):
    """Write voltages that excite the hysteresis, creep and dynamics of a stage.

    Apply them to the stage, and record voltage and displacement. The file record.csv
    begins with a rest and contains all parts twice: identify fits the first half of the
    record and validates on the second. --points writes each part once, to its own file,
    at a lower rate or with a shorter multisine if needed; an NV200 has 1024 points at a
    --rate of 20000. Record each part, and give all records to identify together.

    With RESULTS, a folder of tune with a fitted plant, the voltages are designed for
    this plant and these gains: they make the errors of the promised figures small that
    the errors of the plant cause. Limits and rate are those of its study by default,
    and the slew rate is that of the amplifier in the study, or of the record. Ctrl-C
    ends their search, and keeps the best ones so far.
    """

    def body(console):
        known = {name: value for name, value in limits.items() if value is not None}
        if results is not None:
            if points is not None and duration is not None:
                raise ValueError(
                    "--points and --duration both set the length of a designed "
                    "record; leave one out"
                )
            _write_designed(results, known, duration, points, out, seed, console)
            return
        if duration is not None:
            raise ValueError(
                "--duration is that of a designed record; give RESULTS, or set the "
                "duration of the usual record by --slowest and --hold"
            )
        if missing := [f"--{name}" for name in NEEDED if name not in known]:
            raise ValueError(
                f"{missing[0]} is missing; without RESULTS, give "
                + ", ".join(f"--{name}" for name in NEEDED)
            )
        _write_usual(known, points, out, seed, console)

    run(quiet, body)


def _write_usual(limits, points, out, seed, console):
    """Write the voltages for a stage that is not known yet."""
    from ..report.excitation_pictures import excitation_page
    from ..signals.excitation import Generator, Part, buffered, excitation

    generator = Generator(**limits)
    if points is None:
        parts, whole = excitation(generator, seed or 0)
        files = {RECORD: Part("record", whole, generator.rate, "")}
    else:
        parts = buffered(generator, points, seed or 0)
        files = {f"{part.name}.csv": part for part in parts}
    with results_folder(out, "excitation") as folder:
        page = excitation_page(parts, files)
        _write(folder, files, parts, page)
    print_results(page, folder, console)


def known_slew(case: "Case") -> float:
    """Return the slew rate of the amplifier in the study, or that of the record, V/s.

    Raises ValueError if neither is known.
    """
    from ..study.make_hardware import slew_rate

    found = slew_rate(case.study, 0)
    if found is None and case.plant_about.input_slews:
        found = case.plant_about.input_slews[0]
    if found is None:
        raise ValueError(
            "--slew is missing, and neither the study (actuator.slew_rate) nor the "
            "record of the plant tells how fast the amplifier is"
        )
    return found


def _write_designed(results, limits, duration, points, out, seed, console):
    """Write the voltages designed for the gains and the plant in ``results``."""
    print_loading(console)
    from ..core.files import write_text
    from ..report.excitation_pictures import next_record_page
    from ..signals.excitation import Generator, Part, after_rest
    from ..tuning.next_record import EXPECTED_FILE, next_record
    from ..tuning.result import load_loop

    with Bar(console) as bar, results_folder(out, "excitation") as folder:
        bar.stage("reading the results")
        # A loop with an alarm may need a better record most.
        case, loop = load_loop(results, accept_unsafe=True)
        bounds = case.study.actuator
        of_study = {
            "lower": bounds.lower,
            "upper": bounds.upper,
            "rate": case.study.rate,
        }
        if "slew" not in limits:
            of_study["slew"] = known_slew(case)
        generator = Generator(**(of_study | limits))
        samples = points or round((duration or SECONDS) * generator.rate)
        found = next_record(
            case, loop, generator, samples, seed=seed or 0, progress=bar
        )
        bar.stage("drawing")
        tells = "the promised figures of the gains"
        part = Part("designed", found.fit, generator.rate, tells)
        if points is None:
            whole = after_rest(generator, (found.fit, found.validate))
            files = {RECORD: Part("record", whole, generator.rate, "")}
        else:
            files = {DESIGNED: part}
        write_text(folder / EXPECTED_FILE, found.report.model_dump_json(indent=2))
        page = next_record_page(found.report, part, files)
        _write(folder, files, [part], page)
    print_results(page, folder, console)


def _write(folder, files, parts, page):
    """Write the voltages of ``files``, the picture of ``parts``, and the page."""
    from ..core.files import write_text
    from ..report.excitation_pictures import write_excitation
    from ..report.page import write_page

    for name, part in files.items():
        write_text(folder / name, csv_of(part))
    write_page(page, folder, write_excitation(parts, folder))


def csv_of(part) -> str:
    """Return the times and voltages of a part as CSV."""
    rows = (f"{k / part.rate:.9g},{u:.6f}" for k, u in enumerate(part.voltages))
    return "\n".join(["time_s,voltage_V", *rows]) + "\n"
