"""Retuning on the stage itself: run, fit the plant again, tune on it, run."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..core.files import read_model
from ..core.paths import scalars
from ..core.progress import Progress, Silent
from ..core.serial import save
from ..identification import Record, identify
from ..identification.estimators.estimate import Options
from ..identification.known_plant import KnownPlant
from ..identification.residual_record import ResidualRecord, save_residual
from ..stages import Stage
from ..stages.of_study import motions_of
from ..stages.try_gains import SMALL, abandoned
from ..study import Case, Study, build, load, sha256_of
from ..study.parameters import PART
from ..study.search_tables import TunedTable
from .attempts import RETUNE_FILE, Attempt, RetuneReport
from .outcome import Outcome
from .result import GAINS_FILE
from .stage_bench import PROBE, Bench, geometric_mean, small_motion
from .tuner import tune

RUNS = 10
"""Default number of runs on the stage."""

WITHIN, LEAST, MOST = 10.0, 1.5, 100.0
"""First, smallest and largest value of the factor by which a gain may change."""

NEAR = 1.3
"""Ratio of the measured to the predicted error of better gains up to which this factor
grows."""

ENOUGH = 0.95
"""Ratio of the predicted to the best error above which gains are not tried, once tuned
gains were run."""

PATIENCE = 2
"""Number of attempts in a row without an improvement that end the retuning."""


def retune(
    study: str | Path,
    stage: Stage,
    folder: Path,
    *,
    runs: int = RUNS,
    seed: int | None = None,
    name: str = "stage",
    progress: Progress | None = None,
) -> RetuneReport:
    """Improve the gains of ``stage`` for the references of ``study``, in ``runs`` runs.

    The gains of the stage are saved and measured first. Then three steps repeat: the
    plant is fitted to the last runs, the study is tuned on it near the best gains, and
    the stage follows a small motion and all tuning references with the new gains. Gains
    with an alarm are not tried. After gains that are not better, and at the end, the
    best gains are set again. If the retuning is stopped, the safe gains are set.

    ``folder`` receives the samples of every run, the models, the best gains and, after
    each step, the report. A report in it is continued.

    Raises ValueError for a study with several axes or an amplifier, a plant that was
    not fitted, a stage that lacks a tuned gain or has another sample time, and a report
    of another study; and as ``build`` does.
    """
    progress, path = progress or Silent(), Path(study)
    description = load(path)
    case = build(description, path, seed, progress)
    _check(case, stage)
    bench = Bench(
        stage,
        motions_of(description, path.parent, dict.fromkeys(case.study.references.tune)),
        folder,
        _report(folder, name, description, case, stage),
        runs,
        progress,
    )
    plant = KnownPlant(case.loop.plant, case.plant_about)
    bench.write()
    try:
        if bench.report.best is None:
            _measure_present(bench)
        else:
            bench.restore()
        _improve(bench, plant, case, path)
        if bench.report.best is None:
            bench.restore()
            bench.report.alarms.append(
                "no gains followed the references; the safe gains of the stage are set"
            )
        bench.report.verdict = "done"
    except BaseException as error:
        bench.report.verdict, alarm = abandoned(stage, error)
        bench.report.alarms.append(alarm)
        bench.write()
        if isinstance(error, _HopelessError):
            return bench.report
        raise
    bench.write()
    return bench.report


class _HopelessError(Exception):
    """A small motion with the best or the safe gains was stopped."""


def _check(case: Case, stage: Stage) -> None:
    """Raise ValueError if ``stage`` is not that of ``case``."""
    if case.amplifier is not None:
        raise ValueError(
            "actuator: the plant of a study with an amplifier is not fitted again; "
            "leave out its bandwidth, delay and computation: they are in the runs"
        )
    if not math.isclose(stage.dt, case.study.dt, rel_tol=1e-6):
        raise ValueError(
            f"the stage runs at {1.0 / stage.dt:.6g} Hz and the study at "
            f"{case.study.rate:.6g} Hz; they must be the same"
        )
    known = stage.gains()
    for path in case.space.ranges():
        if (gain := path.removeprefix(PART)) not in known:
            raise ValueError(
                f"the study tunes {path}, but the stage has no gain {gain}; it has "
                f"{', '.join(known)}"
            )


def _report(
    folder: Path, name: str, study: Study, case: Case, stage: Stage
) -> RetuneReport:
    """Return the report in ``folder``, to be continued, or a new one."""
    file, known = folder / RETUNE_FILE, sha256_of(study, case.contents)
    if not file.exists():
        own = scalars(case.loop.controller)
        return RetuneReport(
            stage=name,
            title=study.title,
            study_sha256=known,
            before=stage.gains(),
            units={path: case.unit(PART + path) for path in own},
        )
    report = read_model(RetuneReport, file, "is not the report of a retuning")
    if report.study_sha256 != known:
        raise ValueError(f"{file} is of another study: name a new folder")
    for attempt in report.attempts:
        if attempt.verdict == "running":
            attempt.verdict, attempt.why = "stopped", "the command was interrupted"
    report.verdict, report.alarms = "running", []
    return report


def _measure_present(bench: Bench) -> None:
    """Measure the gains of the stage or, if a run with them is stopped, its safe gains.

    If the safe gains are stopped too, the stage follows small shares of the first
    reference with them. Raises _HopelessError if they are stopped in the small motion.
    """
    report = bench.report
    for kind in ("gains", "safe gains"):
        attempt = Attempt(gains=bench.stage.gains())
        bench.measure(attempt)
        if attempt.measured_um is not None:
            report.best = report.attempts.index(attempt)
            return
        report.notes.append(f"the {kind} of the stage were stopped: {attempt.why}")
    if report.runs[-1].reference != PROBE:
        # Slow gains can follow a small share, and such runs show the plant.
        for share in SMALL:
            bench.run(bench.stage.gains(), bench.motions[0], share)
    else:
        why = report.attempts[-1].why.removeprefix(f"{PROBE}: ")
        raise _HopelessError(f"{PROBE} with the safe gains: {why}")


def _improve(bench: Bench, plant: KnownPlant, case: Case, path: Path) -> None:
    """Fit, tune and run until the runs are used up or no improvement is expected."""
    within, failed = WITHIN, 0
    while bench.enough() and failed < PATIENCE:
        found = _next_gains(bench, plant, case, path, within)
        if found is None:
            break
        attempt, outcome = found
        _try(bench, attempt, outcome)
        failed = 0 if attempt.verdict == "better" else failed + 1
        as_predicted = attempt.error <= NEAR * (attempt.predicted_um or 0.0)
        factor = within**2 if as_predicted and not failed else math.sqrt(within)
        within = min(max(factor, LEAST), MOST)


def _next_gains(
    bench: Bench, plant: KnownPlant, case: Case, path: Path, within: float
) -> tuple[Attempt, Outcome] | None:
    """Return gains that are worth a run, or None; add a note for those that are not.

    The plant is fitted to the last runs. Stopped runs may contain effects that no plant
    explains, such as a limit. If the fit to them gives no such gains, the plant is
    fitted to the other runs alone. A plant on which no gains can be tuned counts as one
    that does not describe the runs.
    """
    report = bench.report
    best = None if report.best is None else report.attempts[report.best].gains
    for records in bench.records():
        file = bench.folder / f"model_{len(report.attempts)}.json"
        bench.progress.stage("fitting the plant to the runs")
        alarms = _fit_again(plant, records, bench.small(records), file)
        runs = ", ".join(record.source for record in records)
        if alarms:
            report.notes.append(f"no plant describes {runs}: {alarms[0]}")
            continue
        study = _near(case, file, best, within)
        try:
            outcome = tune(build(study, path), progress=bench.progress)
        except ValueError as error:
            report.notes.append(f"no gains suit the plant of {runs}: {error}")
            continue
        if outcome.result.status == "interrupted":
            raise KeyboardInterrupt
        gains = scalars(outcome.controller)
        attempt = Attempt(
            gains={path: gains[path] for path in gains if path in report.before},
            model=file.name,
            within=None if best is None else within,
            predicted_um=_predicted(outcome),
        )
        attempt.why = _why_not(attempt, outcome, report, case)
        if not attempt.why:
            return attempt, outcome
        attempt.verdict = "not tried"
        report.attempts.append(attempt)
        report.notes.append(f"{attempt.model}: not tried: {attempt.why}")
    return None


def _why_not(
    attempt: Attempt, outcome: Outcome, report: RetuneReport, case: Case
) -> str:
    """Return why ``attempt`` is not worth a run, "" if it is."""
    fixed = scalars(case.loop.controller)
    for path, value in scalars(outcome.controller).items():
        if path not in report.before and not math.isclose(value, fixed[path]):
            return f"the design changes {path}, and the stage has no such gain"
    if outcome.result.alarms:
        return "; ".join(outcome.result.alarms)
    if attempt.predicted_um is None:
        return "the prediction is not a number"
    if report.tuned and attempt.predicted_um > ENOUGH * report.best_error:
        return "no improvement is expected"
    return ""


def _fit_again(
    plant: KnownPlant, records: Sequence[Record], small: Sequence[Record], file: Path
) -> Sequence[str]:
    """Fit ``plant`` to ``records``; write it with its residual; return its alarms.

    If the plant describes the ``small`` records alone, its dynamics are fitted to them:
    in a large motion, an error of the hysteresis would distort the dynamics. A plant
    that cannot be fitted is not written, and the reason is returned.
    """
    try:
        fit = identify(
            records, plant.model, options=Options(known=_with_shown(plant, small))
        )
    except ValueError as error:
        return [str(error)]
    save(fit.plant, file, about=fit.about)
    save_residual(ResidualRecord.of(fit), file)
    return fit.report.alarms


def _with_shown(plant: KnownPlant, small: Sequence[Record]) -> KnownPlant:
    """Return ``plant``, with dynamics fitted to ``small`` if it describes them."""
    if not small:
        return plant
    every = slice(0, max(record.samples for record in small))
    options = Options(known=plant)
    fit = identify(small, plant.model, train=every, validate=every, options=options)
    return plant if fit.report.alarms else plant.with_dynamics(fit.plant)


def _near(
    case: Case, file: Path, best: Mapping[str, float] | None, within: float
) -> Study:
    """Return the study with the plant in ``file``, to be tuned near the gains ``best``.

    The search starts from ``best`` and changes each gain by the factor ``within`` at
    most. Without ``best`` the search is that of the study.
    """
    changes: dict[str, Any] = {"plant": {"file": str(file.resolve())}}
    if best is not None:
        near = {}
        for path, bounds in case.space.ranges().items():
            value = best[path.removeprefix(PART)]
            low = max(bounds.lower, value / within)
            high = min(bounds.upper, value * within)
            if value > 0.0 and low < high and low <= value <= high:
                near[path] = TunedTable(lower=low, upper=high, start=value)
        changes["parameters"] = {**case.study.parameters, **near}
    return case.study.model_copy(update=changes)


def _predicted(outcome: Outcome) -> float | None:
    """Return the predicted error with the noise of the sensor, um."""
    study = outcome.case.study
    noise = study.by_axis(study.sensor.noise_rms)[0]
    errors = outcome.result.holdout.per_reference_rms_um.values()
    known = [math.hypot(error, noise) for error in errors if error is not None]
    return geometric_mean(known) if len(known) == len(errors) else None


def _try(bench: Bench, attempt: Attempt, outcome: Outcome) -> None:
    """Run ``attempt`` and keep its gains if they are better.

    Raises _HopelessError if it was stopped, and then a small motion with the best gains
    is stopped too.
    """
    report = bench.report
    bench.measure(attempt)
    stopped = attempt.verdict == "stopped"
    if attempt.error < report.best_error:
        attempt.verdict, report.best = "better", report.attempts.index(attempt)
        save(outcome.controller, bench.folder / GAINS_FILE, outcome.about)
    elif not stopped:
        attempt.verdict = "not better"
    bench.write()
    if attempt.verdict != "better":
        bench.restore()
    if stopped and len(report.runs) < bench.budget:
        # A small motion with the best gains shows whether the stage has a fault.
        found = bench.run(bench.stage.gains(), small_motion(bench.motions[0]))
        if found.stopped:
            raise _HopelessError(f"{PROBE} after a stopped run: {found.stopped}")
