"""``python -m piezojax.tune [STUDY.toml] --out DIR``."""

from pathlib import Path

import click

from .. import study as studies
from ..command import INTERRUPTED, Command, common, results_folder, run
from ..report.console import Bar, gains_table, stability_table, tuning_table
from ..report.identification import write_fit
from ..report.stability import compared, write_stability
from ..report.tuning import write_results
from .tuner import tune


@click.command(cls=Command)
@click.argument("study", required=False, type=click.Path(path_type=Path))
@common
def main(study: Path | None, out: Path | None, seed: int | None, quiet: bool) -> None:
    """Tune the controller that STUDY describes, by gradients through the simulation.

    STUDY is a TOML file or the name of a study that comes with piezojax; without it,
    the DOB-based PID-SMC of the P-753 stage is tuned.
    """

    def body(console):
        path = _path_of(study)
        with Bar(console) as bar:
            bar.stage(f"reading {path.name}")
            description = studies.load(path)
            with results_folder(out, path.stem) as folder:
                case = studies.build(description, path, seed=seed)
                outcome = tune(case, progress=bar)
                bar.stage("drawing")
                write_results(outcome, folder)
                if case.fit is not None:
                    write_fit(case.fit, folder)
                bar.stage("working out margins")
                # At the top of the references the branches differ most.
                table = case.study.references
                stability = compared(
                    table.offset + table.amplitude,
                    case.study.dt,
                    before=outcome.before,
                    after=outcome.after,
                )
                write_stability(stability, folder, outcome.result.title)
        result = outcome.result
        console.print(tuning_table(result))
        console.print(gains_table(result))
        console.print(stability_table(stability))
        for name, why in stability.problems.items():
            console.print(f"note: no margins {name} tuning: {why}", soft_wrap=True)
        for warning in result.warnings:
            console.print(f"note: {warning}", soft_wrap=True)
        console.print(
            f"{result.status} after {result.evaluations} evaluations, "
            f"{result.wall_s:.1f} s ({result.compile_s:.1f} s of it compiling); "
            f"results in {folder}",
            soft_wrap=True,
        )
        if result.status == "interrupted":
            raise SystemExit(INTERRUPTED)

    run(quiet, body)


def _path_of(study: Path | None) -> Path:
    if study is None:
        return studies.shipped()
    if study.suffix or study.exists():
        return study
    return studies.shipped(str(study))


if __name__ == "__main__":
    main(prog_name="python -m piezojax.tune")
