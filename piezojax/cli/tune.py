"""``python -m piezojax.tune [STUDY.toml ...] --out DIR``."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from .command import (
    Command,
    common,
    exit_unsafe,
    print_alarms,
    print_loading,
    print_results,
    results_folder,
    run,
)
from .stopping import exit_interrupted
from .terminal import Bar

# The bodies import JAX and its users, so that --help does not wait for them.
if TYPE_CHECKING:
    from concurrent.futures import Future

    from ..core.progress import Progress
    from ..tuning.baselines import Budget
    from ..tuning.gain_surrogate import GainSurrogate
    from ..tuning.outcome import Outcome
    from ..tuning.result import Result


sliders_option = click.option(
    "--sliders/--no-sliders",
    default=True,
    help="Add sliders to the page that show the results of gains near the tuned ones "
    "(takes seconds).",
)


@click.command(cls=Command)
@click.argument("study", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--baselines",
    is_flag=True,
    help="Also tune by Ziegler-Nichols, a relay, CMA-ES and Nelder-Mead (takes "
    "minutes).",
)
@sliders_option
@click.option(
    "--schema",
    is_flag=True,
    help="Print the JSON schema of a study, for editors, and end.",
)
@common
def main(
    study: tuple[Path, ...],
    baselines: bool,
    sliders: bool,
    schema: bool,
    out: Path | None,
    seed: int | None,
    quiet: bool,
) -> None:
    """Tune the controller that STUDY describes, by gradients through the simulation.

    STUDY is a TOML file or the name of a study that comes with piezojax; without it, a
    PI with a learned inverse is tuned on the P-753 stage. Several studies, or a
    comparison (controllers and rates in one file, such as comparison/p753), are tuned
    one after another, each into its own folder. One table and one picture compare them.

    Exit status 3 means that the run finished with an alarm: the loop violates a limit,
    diverges or stays at a voltage limit, or the model is not validated. The alarms are
    printed first, and gains.toml loads only with accept_unsafe.
    """

    def body(console: Console) -> None:
        if not schema:
            print_loading(console)
        from .. import study as studies
        from ..tuning.baselines import Budget

        if schema:
            click.echo(json.dumps(studies.study_schema(), indent=2))
            return
        paths = [study_path(name) for name in study] or [studies.shipped()]
        if len(paths) > 1 or studies.is_comparison_study(paths[0]):
            if baselines:
                raise ValueError("--baselines takes one study, not a comparison")
            _compare(paths, out, seed, console)
        else:
            budget = Budget() if baselines else None
            outcome = tune_study(paths[0], out, seed, budget, console, sliders=sliders)
            finish(outcome.result)

    run(quiet, body)


def finish(result: "Result") -> None:
    """End the command if ``result`` was interrupted or has alarms."""
    if result.status == "interrupted":
        exit_interrupted()
    exit_unsafe(result.alarms)


def tune_study(
    path: Path,
    out: Path | None,
    seed: int | None,
    baselines: "Budget | None",
    console: Console,
    *,
    sliders: bool,
) -> "Outcome":
    """Tune the study at ``path``, write and print the outcome, and return it."""
    from concurrent.futures import ThreadPoolExecutor

    from .. import study as studies
    from ..report.baseline_curves import write_baselines
    from ..report.bode import write_stability
    from ..report.fit_pictures import write_fit
    from ..report.gain_sliders import gain_sliders
    from ..report.limit_bars import write_limit
    from ..report.page import write_page
    from ..report.response_pictures import write_response
    from ..report.tuning_page import tuning_page
    from ..report.tuning_pictures import write_results
    from ..tuning.gain_surrogate import gain_surrogate
    from ..tuning.tuner import tune

    # Gains near the tuned ones are simulated in a thread while the pictures are drawn.
    with Bar(console) as bar, ThreadPoolExecutor(1) as pool:
        bar.stage(f"reading {path.name}")
        description = studies.load(path)
        with results_folder(out, path.stem) as folder:
            case = studies.build(description, path, seed=seed, progress=bar)
            if case.fit is not None:
                # Printed before the search, which takes minutes.
                print_alarms(console, case.fit.report.alarms)
            outcome = tune(case, baselines=baselines, progress=bar)
            bar.finish()
            near = pool.submit(gain_surrogate, outcome) if sliders else None
            bar.stage("drawing")
            if outcome.baselines is not None:
                write_baselines(outcome.baselines, folder)
            heading = outcome.result.heading
            pictures = write_results(outcome, folder)
            if case.fit is not None:
                pictures |= write_fit(case.fit, folder)
            if case.response is not None:
                pictures |= write_response(case.response, folder)
            pictures |= write_stability(outcome.stability, folder, heading)
            bar.stage("computing the limit of linear control")
            write_limit(outcome.limit, folder, heading)
            surrogate = near and _surrogate(near, bar)
            page = tuning_page(outcome, surrogate)
            write_page(page, folder, pictures, gain_sliders(surrogate, outcome))
    print_results(page, folder, console)
    return outcome


def _surrogate(
    found: "Future[GainSurrogate | str]", progress: "Progress"
) -> "GainSurrogate | str":
    """Return the surrogate when it is ready, or why there is none."""
    progress.stage("simulating gains near the tuned ones")
    try:
        return found.result()
    except KeyboardInterrupt:
        return "interrupted"


def _compare(
    paths: Sequence[Path], out: Path | None, seed: int | None, console: Console
) -> None:
    from .. import study as studies
    from ..report.comparison_map import comparison_page, write_comparison
    from ..report.page import write_page
    from ..report.tuning_pictures import write_numbers
    from ..tuning.comparison import compare

    with Bar(console) as bar:
        bar.stage(f"reading {', '.join(path.name for path in paths)}")
        title, entries = studies.read_compared(paths, seed)
        with results_folder(out, "comparison") as folder:

            def keep(outcome: "Outcome") -> None:
                subfolder = folder / outcome.case.name
                subfolder.mkdir()
                write_numbers(outcome, subfolder)

            comparison = compare(title, entries, progress=bar, done=keep)
            bar.finish()
            bar.stage("drawing")
            write_comparison(comparison, folder)
            page = comparison_page(comparison, len(entries))
            write_page(page, folder)
    print_results(page, folder, console)
    if comparison.status == "interrupted":
        exit_interrupted()
    exit_unsafe(page.alarms)


def study_path(study: Path) -> Path:
    """Return the path of a study file, or of the study shipped under a name."""
    from .. import study as studies

    if study.suffix or study.exists():
        return study
    return studies.shipped(str(study))
