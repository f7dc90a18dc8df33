"""Retuning on the stage itself: run, fit the plant again, tune on it, run."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from ..core.files import read_model, write_text
from ..core.paths import scalars
from ..core.progress import Progress, Silent
from ..core.serial import save
from ..identification import Record, identify
from ..identification.estimators.estimate import Options
from ..identification.known_plant import KnownPlant
from ..identification.residual_record import ResidualRecord, save_residual
from ..stages import Motion, Stage, TriedRun
from ..stages.of_study import motions_of
from ..stages.probe import probe
from ..stages.run_files import load_samples, run_file
from ..stages.try_gains import abandoned, tried
from ..study import Case, Study, build, load, sha256_of
from ..study.parameters import PART
from ..study.schema import TunedTable
from .outcome import Outcome
from .result import GAINS_FILE
from .tuner import tune

RETUNE_FILE = "retune.json"

PROBE = "small motion"
"""Name of the small motion in the list of runs."""

RUNS = 10
"""Default number of runs on the stage."""

WITHIN, LEAST, MOST = 10.0, 1.5, 100.0
"""Factor by which a gain may change at first, the smallest and the largest one."""

RINGING = 2.0
"""Ratio of the rms error in the small motion to that of the motion itself above which
the loop rings: a sensitivity peak of 2 allows no more."""

NEAR = 1.3
"""Ratio of the measured to the predicted error up to which this factor grows."""

ENOUGH = 0.95
"""Ratio of the predicted to the best error above which the retuning ends."""

PATIENCE = 2
"""Number of attempts in a row without an improvement after which it ends."""

FITTED, SHORTEST = 4, 400
"""Number of runs to which the plant is fitted, the last ones; fewest samples of a run
that was stopped."""

AttemptVerdict = Literal[
    "running", "measured", "better", "not better", "stopped", "not tried"
]


class Attempt(BaseModel):
    """Gains of a stage, what was expected of them and what they did.

    ``gains`` are all gains of the controller. ``model`` is the file of the plant on
    which they were tuned, ``within`` the largest factor between a tuned gain and the
    best one before; "" and None for gains that were on the stage, and without a best
    one. ``predicted_um`` and ``measured_um`` are rms errors with the noise of the
    sensor, geometric means over the references; None if they are not known. ``why`` is
    the reason for which gains were stopped, or not tried.
    """

    gains: dict[str, float]
    model: str = ""
    within: float | None = None
    predicted_um: float | None = None
    measured_um: float | None = None
    verdict: AttemptVerdict = "running"
    why: str = ""

    @property
    def error(self) -> float:
        """Measured error, um; infinite if it is not known."""
        return math.inf if self.measured_um is None else self.measured_um


class RetuneReport(BaseModel):
    """Report of a retuning, the content of ``retune.json``.

    ``before`` are all gains of the stage before, ``units`` their units by path. The
    ``attempts`` begin with gains that were on the stage. ``best`` is the place of those
    that are set at the end; None if these are the safe gains. ``verdict`` is "done",
    "stopped" (the user or a fault ended it: the safe gains are set) or "lost" (no
    connection); "running" until then.
    """

    stage: str
    study_sha256: str
    before: dict[str, float]
    units: dict[str, str] = {}
    runs: list[TriedRun] = []
    attempts: list[Attempt] = []
    best: int | None = None
    verdict: Literal["running", "done", "stopped", "lost"] = "running"
    alarms: list[str] = []
    notes: list[str] = []

    @property
    def best_error(self) -> float:
        """Smallest measured error, um; infinite without one."""
        return math.inf if self.best is None else self.attempts[self.best].error

    @property
    def tuned(self) -> bool:
        """Whether tuned gains were run; the first show what the start hides."""
        return any(each.model and each.verdict != "not tried" for each in self.attempts)

    @property
    def ratio(self) -> float:
        """Error at the beginning relative to the best one; infinite if a run with these
        gains was stopped."""
        return self.attempts[0].error / self.best_error if self.attempts else math.nan


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

    The gains of the stage are saved and measured first. Then, in turn, the plant is
    fitted to the last runs, the study is tuned on it near the best gains, and the new
    gains follow a small motion and all references to tune on. Gains with an alarm are
    not tried. The best gains are set again after others that are not better, and at the
    end. Any other end leaves the safe gains of the stage.

    ``folder`` receives the samples of every run, the models, the best gains and, after
    each step, the report. A report in it is continued.

    Raises ValueError for a study with several axes or an amplifier, a plant that was
    not fitted, a stage with other gains or another sample time, and a report of another
    study; and as ``build`` and ``identify`` do.
    """
    progress, path = progress or Silent(), Path(study)
    description = load(path)
    case = build(description, path, seed, progress)
    _check(case, stage)
    bench = _Bench(
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
    """The stage does not follow with gains that it followed with, or with safe ones."""


def _check(case: Case, stage: Stage) -> None:
    """Raise ValueError if ``stage`` is not that of ``case``."""
    if case.amplifier is not None:
        raise ValueError(
            "actuator: the plant of a study with an amplifier is not fitted again; "
            "leave out its bandwidth, current and delay: they are in the runs"
        )
    if not math.isclose(stage.dt, case.study.dt, rel_tol=1e-6):
        raise ValueError(
            f"the stage runs at {1.0 / stage.dt:.6g} Hz and the study at "
            f"{case.study.rate:.6g} Hz; they must be the same"
        )
    known = stage.gains()
    for path in scalars(case.loop.controller):
        if path not in known:
            raise ValueError(
                f"the controller of the study has the gain {path}, the stage has "
                f"{', '.join(known)}"
            )


def _report(
    folder: Path, name: str, study: Study, case: Case, stage: Stage
) -> RetuneReport:
    """Return the report in ``folder`` to go on with, or a new one."""
    file, known = folder / RETUNE_FILE, sha256_of(study)
    if not file.exists():
        own = scalars(case.loop.controller)
        return RetuneReport(
            stage=name,
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


@dataclass
class _Bench:
    """The stage with its runs: what was run, and what may still be run."""

    stage: Stage
    motions: Sequence[Motion]
    folder: Path
    report: RetuneReport
    budget: int
    progress: Progress

    def enough(self) -> bool:
        """Return whether another attempt can be run."""
        return len(self.report.runs) + 1 + len(self.motions) <= self.budget

    def write(self) -> None:
        """Write the report."""
        text = self.report.model_dump_json(indent=2) + "\n"
        write_text(self.folder / RETUNE_FILE, text)

    def measure(self, attempt: Attempt) -> None:
        """Run a small motion and the references with the gains of ``attempt``."""
        self.report.attempts.append(attempt)
        errors = []
        for motion in (_small(self.motions[0]), *self.motions):
            found = self.run(attempt.gains, motion)
            stopped = found.stopped
            if motion.name == PROBE and _rings(found, motion):
                self.stage.safe()  # the guard has not seen it
                stopped = "the loop rings"
            if stopped or found.measured_um is None:
                attempt.verdict, attempt.why = "stopped", f"{motion.name}: {stopped}"
                return
            errors.append(found.measured_um)
        attempt.measured_um = _mean(errors[1:])
        attempt.verdict = "measured"

    def run(self, gains: Mapping[str, float], motion: Motion) -> TriedRun:
        """Follow ``motion`` with ``gains``."""
        runs = self.report.runs
        self.progress.stage(f"run {len(runs) + 1} of {self.budget}: {motion.name}")
        file = run_file(self.folder, len(runs) + 1)
        found = tried(self.stage, gains, motion, 1.0, file)
        runs.append(found)
        self.write()
        return found

    def restore(self) -> None:
        """Set the best gains, if there are any."""
        if self.report.best is not None:
            self.stage.apply(self.report.attempts[self.report.best].gains)

    def records(self) -> list[Record]:
        """Return the last runs as records, each until its first missing number."""
        found = []
        for run in self.report.runs[-FITTED:]:
            columns = np.stack(load_samples(self.folder / run.file))
            known = np.cumprod(np.isfinite(columns).all(axis=0)).astype(bool)
            reference, measured, voltage = columns[:, known]
            if len(measured) >= SHORTEST and np.ptp(measured) > 0.0 < np.ptp(voltage):
                about = {"source": run.file, "reference": reference}
                found.append(Record(voltage, measured, self.stage.dt, **about))
        return found


def _small(motion: Motion) -> Motion:
    """Return the small motion before ``motion``."""
    return Motion(PROBE, probe(motion.reference), None, motion.start, motion.noise)


def _rings(run: TriedRun, motion: Motion) -> bool:
    """Return whether the error of a ``run`` is too large for its small ``motion``."""
    return (run.measured_um or 0.0) > RINGING * float(np.std(motion.reference))


def _mean(errors: Sequence[float]) -> float:
    """Return the geometric mean of ``errors`` (um)."""
    return float(np.exp(np.mean(np.log(np.maximum(errors, 1e-12)))))


def _measure_present(bench: _Bench) -> None:
    """Measure the gains of the stage; if they are stopped, its safe gains.

    Raises _HopelessError if a small motion with the safe gains is stopped.
    """
    report = bench.report
    for kind in ("gains", "safe gains"):
        attempt = Attempt(gains=bench.stage.gains())
        bench.measure(attempt)
        if attempt.measured_um is not None:
            report.best = report.attempts.index(attempt)
            return
        report.notes.append(f"the {kind} of the stage were stopped: {attempt.why}")
    if report.runs[-1].reference == PROBE:
        why = report.attempts[-1].why.removeprefix(f"{PROBE}: ")
        raise _HopelessError(f"{PROBE} with the safe gains: {why}")


def _improve(bench: _Bench, plant: KnownPlant, case: Case, path: Path) -> None:
    """Fit, tune and run until the runs are used up or no improvement is expected."""
    report, within, failed = bench.report, WITHIN, 0
    while bench.enough() and failed < PATIENCE:
        file = bench.folder / f"model_{len(report.attempts)}.json"
        bench.progress.stage("fitting the plant to the runs")
        records = bench.records()
        if not records:
            report.notes.append("no run is long enough to fit the plant to it")
            break
        alarms = _fit_again(plant, records, file)
        if alarms:
            report.notes.append(f"{file.name} describes the runs badly: {alarms[0]}")
            break
        best = None if report.best is None else report.attempts[report.best].gains
        study = _near(case, file, best, within)
        outcome = tune(build(study, path), progress=bench.progress)
        if outcome.result.status == "interrupted":
            raise KeyboardInterrupt
        attempt = Attempt(
            gains=scalars(outcome.controller),
            model=file.name,
            within=None if best is None else within,
            predicted_um=_predicted(outcome),
        )
        if not _try(bench, attempt, outcome):
            break
        failed = 0 if attempt.verdict == "better" else failed + 1
        as_predicted = attempt.error <= NEAR * (attempt.predicted_um or 0.0)
        factor = within**2 if as_predicted and not failed else math.sqrt(within)
        within = min(max(factor, LEAST), MOST)


def _fit_again(
    plant: KnownPlant, records: Sequence[Record], file: Path
) -> Sequence[str]:
    """Fit ``plant`` to ``records``; write it with its residual; return its alarms."""
    fit = identify(records, plant.model, options=Options(known=plant))
    save(fit.plant, file, about=fit.about)
    save_residual(ResidualRecord.of(fit), file)
    return fit.report.alarms


def _near(
    case: Case, file: Path, best: Mapping[str, float] | None, within: float
) -> Study:
    """Return the study with the plant in ``file``, to be tuned near the gains ``best``.

    The search starts from them, and changes each by the factor ``within`` at most.
    Without them it is that of the study.
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
    return _mean(known) if len(known) == len(errors) else None


def _try(bench: _Bench, attempt: Attempt, outcome: Outcome) -> bool:
    """Run ``attempt`` and keep its gains if they are better; return if it was run.

    Raises _HopelessError if it was stopped and the best gains are stopped since.
    """
    report = bench.report
    if outcome.result.alarms:
        attempt.why = "; ".join(outcome.result.alarms)
    elif attempt.predicted_um is None:
        attempt.why = "the prediction is not a number"
    elif report.tuned and attempt.predicted_um > ENOUGH * report.best_error:
        attempt.why = "no improvement is expected"
    if attempt.why:
        attempt.verdict = "not tried"
        report.attempts.append(attempt)
        report.notes.append(f"{attempt.model}: not tried: {attempt.why}")
        return False
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
        # The gains, or a fault of the stage? Gains that it followed with tell.
        found = bench.run(bench.stage.gains(), _small(bench.motions[0]))
        if found.stopped:
            raise _HopelessError(f"{PROBE} after a stopped run: {found.stopped}")
    return True
