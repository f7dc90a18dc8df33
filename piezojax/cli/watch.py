"""``python -m piezojax.watch RESULTS --stage NAME``."""

from pathlib import Path

import click

from .command import Command, common, exit_unsafe, print_results, results_folder, run
from .on_stage import connected, stage_option, tuned_gains
from .terminal import Bar

BASELINE, LATER = 12, 3
"""Default numbers of runs, without and with a baseline."""


@click.command(cls=Command)
@click.argument("results", type=click.Path(path_type=Path))
@stage_option
@click.option(
    "--baseline",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of an earlier watch with which to compare (default: the runs become a "
    "baseline).",
)
@click.option(
    "--runs",
    type=click.IntRange(min=1),
    help=f"Number of runs (default: {BASELINE} for a baseline, {LATER} later).",
)
@click.option(
    "--false-alarms",
    type=click.FloatRange(0.0, 0.5, min_open=True),
    default=0.01,
    show_default=True,
    help="Share of the runs of an unchanged stage that count as changed.",
)
@click.option("--reference", help="Reference of the study (default: the first).")
@common
def main(results, name, baseline, runs, false_alarms, reference, out, seed, quiet):
    """Watch whether a stage still moves as it did, with the gains in RESULTS of tune.

    The first time, several runs of a reference become the baseline. Later, --baseline
    compares new runs with it: a change of gain, lag, error or noise beyond the scatter
    of the baseline is an alarm.
    """
    del seed  # nothing is random

    def body(console):
        from ..report.page import write_page
        from ..report.watch_report import watch_page, write_watch
        from ..stages import watch
        from ..study.tables import one_of

        result, gains, motions = tuned_gains(results)
        by_name = {motion.name: motion for motion in motions}
        motion = by_name[one_of(reference or motions[0].name, by_name)]
        count = runs or (LATER if baseline else BASELINE)
        with (
            Bar(console, at_once=True) as bar,
            results_folder(out, f"{results.name}_watch") as folder,
        ):
            bar.stage("connecting to the stage")
            with connected(name) as stage:
                found = watch(
                    stage,
                    gains,
                    motion,
                    folder,
                    baseline=baseline,
                    runs=count,
                    false_alarms=false_alarms,
                    name=name,
                    progress=bar,
                )
            bar.finish()
            bar.stage("drawing")
            write_watch(found, folder)
            page = watch_page(found, result.title)
            write_page(page, folder)
        print_results(page, folder, console)
        exit_unsafe(page.alarms)

    run(quiet, body)
