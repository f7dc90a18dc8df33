"""``python -m piezojax.sweep [STUDY.toml] --out DIR [--shard i/n]``."""

import re
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from ..core.files import numbered_folder
from ..core.runtime import simulate_side_by_side
from .command import RESULTS, Command, common, print_loading, print_page, run
from .stopping import exit_interrupted
from .terminal import Bar

# The bodies import JAX and its users, so that --help does not wait for them.
if TYPE_CHECKING:
    from ..report.page import Page
    from ..sweeping.sweeper import SweepResult


def _shard(context: click.Context, option: click.Parameter, text: str) -> tuple:
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise click.BadParameter(f"{text!r}; it must be i/n, from 1/n to n/n")
    return int(match[1]), int(match[2])


@click.command(cls=Command)
@click.argument("study", required=False, type=click.Path(path_type=Path))
@click.option(
    "--shard",
    default="1/1",
    callback=_shard,
    metavar="i/n",
    help="Run the i-th of n parts; the part that finishes last merges all.",
)
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    default=None,
    help="Number of random points; without a [sweep] they are drawn from the bounds of "
    "[parameters].",
)
@click.option(
    "--dask",
    metavar="WHERE",
    default=None,
    help="Simulate on Dask workers: address of a scheduler, or number of workers to "
    "start on this machine.",
)
@common
def main(
    study: Path | None,
    shard: tuple[int, int],
    samples: int | None,
    dask: str | None,
    out: Path | None,
    seed: int | None,
    quiet: bool,
) -> None:
    """Simulate every point of the [sweep] of STUDY, and write one labelled data set.

    STUDY is a TOML file or the name of a study that comes with piezojax; without it,
    two gains of the P-753's controller are mapped. A sweep that was interrupted
    or killed resumes when called again with the same --out.
    """
    simulate_side_by_side()

    def body(console: Console) -> None:
        print_loading(console)
        from ..report.page import write_page
        from ..report.sweep_maps import sweep_page, write_pictures
        from ..sweeping.cluster import dask_client
        from ..sweeping.sweeper import read_swept, run_sweep

        if shard != (1, 1) and out is None:
            raise ValueError("--shard needs --out, the folder that all shards share")
        path = _study_path(study)
        folder, page = out, None
        try:
            with Bar(console) as bar:
                bar.stage(f"reading {path.name}")
                case = read_swept(path, seed=seed, samples=samples)
                folder = out or numbered_folder(RESULTS / path.stem)
                with nullcontext() if dask is None else dask_client(dask) as client:
                    result = run_sweep(
                        case, folder, shard=shard, client=client, progress=bar
                    )
                if result.finished:
                    bar.finish()
                    bar.stage("drawing")
                    pictures = write_pictures(result.path, folder)
                    page = sweep_page(result.path)
                    write_page(page, folder, pictures)
        except KeyboardInterrupt:
            if folder is None or not folder.exists():
                raise
            click.echo(
                "interrupted; finished chunks are kept, and the same command with "
                f"--out {folder} resumes the sweep",
                err=True,
            )
            exit_interrupted()
        _report(result, page, folder, shard, console)

    run(quiet, body)


def _report(
    result: "SweepResult",
    page: "Page | None",
    folder: Path,
    shard: tuple[int, int],
    console: Console,
) -> None:
    from ..report.page import PAGE

    if page is not None:
        print_page(page, console)
    if result.simulated:
        rate = result.lane_steps / result.core_s
        console.print(
            f"{result.lane_steps:.3g} samples in {result.wall_s:.1f} s, "
            f"{result.core_s:.3g} core-seconds of simulation: {rate:.3g} samples per "
            "second and core",
            soft_wrap=True,
        )
    if result.finished:
        console.print(
            f"page: {folder / PAGE}; results in {folder}, data set {result.path}",
            soft_wrap=True,
        )
    else:
        console.print(
            f"shard {shard[0]}/{shard[1]} is complete, {result.chunks} chunks; the "
            f"data set is merged when all other shards in {folder} are complete",
            soft_wrap=True,
        )


def _study_path(study: Path | None) -> Path:
    from .. import study as studies
    from ..sweeping.sweeper import DEFAULT

    if study is None:
        return studies.shipped(DEFAULT)
    if study.suffix or study.exists():
        return study
    return studies.shipped(str(study))
