"""``python -m piezojax.emulate STUDY``."""

from contextlib import suppress
from pathlib import Path

import click

from .command import Command, run


@click.command(cls=Command)
@click.argument("study", type=click.Path(path_type=Path))
@click.option(
    "--plant",
    type=click.Path(path_type=Path),
    help="Saved model to emulate instead of the plant of the study.",
)
@click.option(
    "--gain", type=float, default=1.0, help="Factor on the displacement (default: 1)."
)
@click.option(
    "--delay",
    type=click.FloatRange(0.0, 5.0),
    default=0.0,
    help="Additional delay of the stage, samples (default: 0).",
)
@click.option(
    "--slew",
    type=click.FloatRange(min=0.0, min_open=True),
    help="Slew limit of the guard, V/s (default: the range of the voltage in 5 ms).",
)
@click.option(
    "--largest-error",
    type=click.FloatRange(min=0.0, min_open=True),
    help="Tracking error at which the guard stops a run, um (default: a quarter of "
    "the range of the references).",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    help="Port of this machine at which the stage answers (default: a free one).",
)
@click.option(
    "--speed",
    type=click.FloatRange(min=0.0),
    default=1.0,
    help="Duration of a run relative to real time: 2 takes twice as long, 0 runs as "
    "fast as possible (default: 1).",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, help="Seed of noise and drift."
)
@click.option("--quiet", is_flag=True, help="Print only the address.")
def main(study, plant, gain, delay, slew, largest_error, port, speed, seed, quiet):
    """Emulate the stage of a STUDY, to try gains without hardware.

    The stage has the plant, the controller, the limits and the noise of the STUDY;
    --plant, --gain and --delay make it differ from the model. It answers other commands
    at the printed address until Ctrl-C. If a connection breaks, it sets its safe gains
    and moves to its safe voltage.
    """

    def body(console):
        from ..stages import StageServer
        from ..stages.of_study import emulated_stage

        stage = emulated_stage(
            study,
            plant=plant,
            gain=gain,
            delay=delay,
            slew=slew,
            largest_error=largest_error,
            speed=speed,
            seed=seed,
        )
        with StageServer(stage, port) as server:
            click.echo(f"stage at {server.address}")
            console.print("Ctrl-C ends it")
            with suppress(KeyboardInterrupt):
                server.serve_forever()
        console.print("the emulator has ended")

    run(quiet, body)
