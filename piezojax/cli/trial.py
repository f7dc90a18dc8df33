"""``python -m piezojax.trial RESULTS --stage NAME``."""

from pathlib import Path

import click

from .command import Command, common, exit_unsafe, print_results, results_folder, run
from .terminal import Bar


@click.command(cls=Command)
@click.argument("results", type=click.Path(path_type=Path))
@click.option(
    "--stage",
    "name",
    required=True,
    metavar="NAME",
    help="Stage: host:port, as printed by python -m piezojax.emulate, or "
    "module:function of your own stage.",
)
@common
def main(results, name, out, seed, quiet):
    """Try the gains in the folder RESULTS of tune on a stage.

    A small motion comes first, then every reference of the study. The gains are kept if
    each error is at most twice the promised one; otherwise those that the stage had
    before are set again. After a fault, Ctrl-C or a lost connection the stage has its
    safe gains.
    """
    del seed  # nothing is random

    def body(console):
        from ..core.serial import load
        from ..report.page import write_page
        from ..report.trial_report import trial_page, write_trial
        from ..stages import RemoteStage, stage_of, trial
        from ..stages.of_study import motions_of
        from ..stages.protocol import StageError
        from ..study import load as load_study
        from ..tuning.result import GAINS_FILE, STUDY_FILE, load_result

        result = load_result(results)
        load(results / GAINS_FILE)  # refuses gains with an alarm
        promised = dict(result.holdout.per_reference_rms_um)
        if result.unseen is not None:
            promised |= result.unseen.per_reference_rms_um
        motions = motions_of(load_study(results / STUDY_FILE), results, promised)
        gains = {
            path.removeprefix("controller."): value
            for path, value in result.gains.items()
        }
        with (
            Bar(console, at_once=True) as bar,
            results_folder(out, f"{results.name}_trial") as folder,
        ):
            bar.stage("connecting to the stage")
            try:
                stage = stage_of(name)
                found = trial(stage, gains, motions, folder, name=name, progress=bar)
            except StageError as error:
                raise ValueError(str(error)) from None
            if isinstance(stage, RemoteStage) and found.verdict != "lost":
                stage.close()
            bar.finish()
            bar.stage("drawing")
            pictures = write_trial(found, folder, motions, stage.dt)
            page = trial_page(found, result.title)
            write_page(page, folder, pictures)
        print_results(page, folder, console)
        exit_unsafe(page.alarms)

    run(quiet, body)
