"""``python -m piezojax.retune STUDY --stage NAME``."""

from pathlib import Path

import click

from .command import (
    Command,
    common,
    exit_unsafe,
    print_results,
    results_folder,
    run,
)
from .on_stage import connected, stage_option
from .terminal import Bar

RUNS = 10
"""Default number of runs on the stage."""


@click.command(cls=Command)
@click.argument("study", type=click.Path(path_type=Path))
@stage_option
@click.option(
    "--runs",
    type=click.IntRange(min=2),
    default=RUNS,
    show_default=True,
    help="Largest number of runs on the stage.",
)
@common
def main(study, name, runs, out, seed, quiet):
    """Improve the gains of a stage for the references of STUDY, on the stage itself.

    The plant of STUDY is fitted to the runs again and again, and the gains are tuned on
    it, near the best ones so far. A small motion comes before the references. Gains
    with an alarm are not tried. After gains that are not better, the best ones are set
    again. After a fault, Ctrl-C or a lost connection the stage has its safe gains. To
    go on after an interruption, give the same folder as --out.
    """

    def body(console):
        from ..report.page import write_page
        from ..report.retune_report import retune_page, write_retuning
        from ..tuning.attempts import RETUNE_FILE
        from ..tuning.retuning import retune

        with (
            Bar(console, at_once=True) as bar,
            results_folder(out, f"{study.stem}_retune", RETUNE_FILE) as folder,
        ):
            bar.stage("connecting to the stage")
            with connected(name) as stage:
                found = retune(
                    study, stage, folder, runs=runs, seed=seed, name=name, progress=bar
                )
            bar.finish()
            bar.stage("drawing")
            pictures = write_retuning(found, folder, stage.dt)
            page = retune_page(found)
            write_page(page, folder, pictures)
        print_results(page, folder, console)
        exit_unsafe(page.alarms)

    run(quiet, body)
