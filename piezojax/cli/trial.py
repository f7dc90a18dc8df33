"""``python -m piezojax.trial RESULTS --stage NAME``."""

from pathlib import Path

import click

from .command import Command, common, exit_unsafe, print_results, results_folder, run
from .on_stage import connected, stage_option, tuned_gains
from .terminal import Bar


@click.command(cls=Command)
@click.argument("results", type=click.Path(path_type=Path))
@stage_option
@common
def main(results, name, out, seed, quiet):
    """Try the gains in the folder RESULTS of tune on a stage.

    The stage follows 10 % and 30 % of the first reference of the study, then every
    reference. The gains are kept if each error is at most twice the promised one;
    otherwise the gains from before are set again. After a fault, Ctrl-C or a lost
    connection the stage has its safe gains.
    """
    del seed  # nothing is random

    def body(console):
        from ..report.page import write_page
        from ..report.trial_report import trial_page, write_trial
        from ..stages import trial

        result, gains, motions = tuned_gains(results)
        with (
            Bar(console, at_once=True) as bar,
            results_folder(out, f"{results.name}_trial") as folder,
        ):
            bar.stage("connecting to the stage")
            with connected(name) as stage:
                found = trial(stage, gains, motions, folder, name=name, progress=bar)
            bar.finish()
            bar.stage("drawing")
            pictures = write_trial(found, folder, motions, stage.dt)
            units = {
                path.removeprefix("controller."): unit
                for path, unit in result.gain_units.items()
            }
            page = trial_page(found, result.title, units)
            write_page(page, folder, pictures)
        print_results(page, folder, console)
        exit_unsafe(page.alarms)

    run(quiet, body)
