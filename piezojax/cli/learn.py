"""``python -m piezojax.learn RESULTS --stage NAME``."""

from pathlib import Path

import click

from .command import Command, common, exit_unsafe, print_results, results_folder, run
from .on_stage import connected, learning_law, stage_option, tuned_gains
from .terminal import Bar


@click.command(cls=Command)
@click.argument("results", type=click.Path(path_type=Path))
@stage_option
@click.option(
    "--reference", help="Reference of the study to repeat (default: the first)."
)
@click.option(
    "--runs",
    type=click.IntRange(min=2),
    default=8,
    show_default=True,
    help="Largest number of runs on the stage.",
)
@click.option(
    "--points",
    type=click.IntRange(min=2),
    help="Also write the learned reference as a table of at most this many points, for "
    "a waveform generator that holds each point.",
)
@click.option(
    "--study",
    "named",
    type=click.Path(path_type=Path),
    help="File of the tuned study, if the files that it names have moved (default: the "
    "study.toml in RESULTS).",
)
@common
def main(results, name, reference, runs, points, named, out, seed, quiet):
    """Learn the reference with which a stage follows a repeated motion.

    The stage repeats a reference of the study with the gains in the folder RESULTS of
    tune; after each run the reference is corrected by the inverse of the closed loop,
    as far as its plant is known. At the end the gains from before are set again; after
    a fault, Ctrl-C or a lost connection the stage has its safe gains.
    """
    del seed  # nothing is random

    def body(console):
        from ..report.learn_report import learn_page, write_learning
        from ..report.page import write_page
        from ..stages.learning import learn_reference

        result, gains, motions = tuned_gains(results, named)
        names = [motion.name for motion in motions]
        if reference is not None and reference not in names:
            raise ValueError(
                f"--reference is {reference!r}; the study has {', '.join(names)}"
            )
        motion = motions[names.index(reference) if reference else 0]
        with (
            Bar(console, at_once=True) as bar,
            results_folder(out, f"{results.name}_learn") as folder,
        ):
            bar.stage("linearising the loop")
            law = learning_law(results, named)
            bar.stage("connecting to the stage")
            options = {"runs": runs, "points": points, "name": name, "progress": bar}
            with connected(name) as stage:
                found = learn_reference(stage, gains, motion, law, folder, **options)
            bar.finish()
            bar.stage("drawing")
            pictures = write_learning(found, folder, stage.dt)
            page = learn_page(found, result.title)
            write_page(page, folder, pictures)
        print_results(page, folder, console)
        exit_unsafe(page.alarms)

    run(quiet, body)
