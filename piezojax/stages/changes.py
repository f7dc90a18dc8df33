"""Detection of a change of a stage by comparing its runs with earlier ones."""

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from ..core.files import read_model, write_report
from ..core.progress import Progress, Silent
from ..identification import Record
from .protocol import Gains, Stage, StageError, StoppedError
from .run_files import load_samples, run_file, run_files, save_samples
from .try_gains import Motion

WATCH_FILE = "watch.json"

FALSE_ALARMS = 0.01
"""Default share of the runs of an unchanged stage that count as changed."""

FEATURES = 4
"""Number of features of a run."""

Samples = Float[np.ndarray, "runs samples"]


class RunFeatures(BaseModel):
    """Features of a run that are compared with those of the baseline.

    ``gain_percent`` and ``lag_us`` (us) are the changes of the gain and of the lag of
    the stage, from voltage to reading, relative to the means of the baseline.
    ``log_error`` is the decimal logarithm of the rms tracking error (um). ``log_rest``
    is that of the rms residual of the voltage (V): the part that a change of scale, lag
    and offset and a linear drift do not explain.
    """

    gain_percent: float
    lag_us: float
    log_error: float
    log_rest: float


class Judgement(BaseModel):
    """Comparison of a run with the baseline.

    ``distance`` is Hotelling's T^2 of the features. It exceeds ``threshold`` in the
    stated share of the runs of an unchanged stage. ``stopped`` is the reason why the
    guard stopped the run; such a run has no features.
    """

    file: str = ""
    features: RunFeatures | None = None
    distance: float | None = None
    threshold: float | None = None
    stopped: str = ""

    @property
    def moved(self) -> bool:
        """Whether the stage has changed; a run that was stopped counts as a change."""
        if self.distance is None or self.threshold is None:
            return True
        return self.distance > self.threshold


class WatchReport(BaseModel):
    """Report of a watch, the content of ``watch.json``.

    ``baseline`` are the features of the runs with which ``runs`` are compared.
    """

    stage: str
    reference: str
    gains: dict[str, float]
    false_alarms: float
    baseline: list[RunFeatures]
    runs: list[Judgement] = []
    alarms: list[str] = []


class Baseline:
    """Runs of an unchanged stage: ``records`` of one reference with the same gains.

    Samples before ``start`` do not count. Raises ValueError for fewer than
    ``FEATURES`` + 2 records, or records of different references.
    """

    def __init__(self, records: Sequence[Record], start: int = 0):
        if len(records) < FEATURES + 2:
            raise ValueError(
                f"a baseline needs at least {FEATURES + 2} runs, not {len(records)}"
            )
        self._start, self._dt = start, records[0].dt
        self._reference = records[0].reference
        for record in records:
            self._check(record)
        self._voltages, self._readings = (
            np.array([getattr(record, side)[start:] for record in records])
            for side in ("input", "output")
        )
        self.features = [
            self._features(record, np.delete(self._voltages, row, axis=0))
            for row, record in enumerate(records)
        ]

    def judge(self, record: Record, false_alarms: float = FALSE_ALARMS) -> Judgement:
        """Compare ``record`` with the baseline.

        The likelihood ratio test of the mean of normal features with unknown covariance
        is Hotelling's. For n runs with p features, their sample covariance S, and the
        difference d of a further run from their mean, T^2 = n / (n + 1) d' S^-1 d
        follows p (n - 1) / (n - p) F(p, n - p) (Anderson, An Introduction to
        Multivariate Statistical Analysis, 3rd ed., 5.3). Raises ValueError for a record
        of another reference.
        """
        from scipy import stats  # slow to import

        self._check(record)
        found = self._features(record, self._voltages)
        rows = np.array([list(each.model_dump().values()) for each in self.features])
        new = np.array(list(found.model_dump().values()))
        count, size = rows.shape
        away = new - rows.mean(axis=0)
        covariance = np.cov(rows, rowvar=False)
        distance = count / (count + 1) * away @ np.linalg.solve(covariance, away)
        quantile = stats.f.isf(false_alarms, size, count - size)
        return Judgement(
            features=found,
            distance=float(distance),
            threshold=float(size * (count - 1) / (count - size) * quantile),
        )

    def _check(self, record: Record) -> None:
        found, known = record.reference, self._reference
        if found is None or known is None or not np.array_equal(found, known):
            raise ValueError("a run can only be compared with runs of its reference")

    def _features(self, record: Record, others: Samples) -> RunFeatures:
        """Return the features of ``record``.

        The residual of its voltage is relative to the mean of the voltages ``others``.
        For a run of the baseline, these are the other runs, so that its residual
        contains the noise of their mean, as that of a later run does.
        """
        voltage, reading = record.input[self._start :], record.output[self._start :]
        assert record.reference is not None
        error = record.reference[self._start :] - reading
        of_voltage, _ = _explained(voltage, self._voltages.mean(axis=0), self._dt)
        of_reading, _ = _explained(reading, self._readings.mean(axis=0), self._dt)
        _, rest = _explained(voltage, others.mean(axis=0), self._dt)
        gain = (1.0 + of_reading[0]) / (1.0 + of_voltage[0]) - 1.0
        advance = of_reading[1] - of_voltage[1]
        return RunFeatures(
            gain_percent=100.0 * float(gain),
            lag_us=-1e6 * float(advance),
            log_error=math.log10(np.sqrt(np.mean(error**2))),
            log_rest=math.log10(np.sqrt(np.mean(rest**2))),
        )


def _explained(
    signal: Float[np.ndarray, " samples"],
    mean: Float[np.ndarray, " samples"],
    dt: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the changes of scale and advance (s) of ``signal`` from ``mean``.

    The second result is the residual after these, an offset and a linear drift.
    """
    columns = [
        mean - mean.mean(),
        np.gradient(mean, dt),
        np.ones_like(mean),
        np.linspace(-1.0, 1.0, len(mean)),
    ]
    matrix = np.column_stack(columns)
    away = signal - mean
    changes = np.linalg.lstsq(matrix, away, rcond=None)[0]
    return changes[:2], away - matrix @ changes


def read_runs(folder: Path, dt: float) -> list[Record]:
    """Return the runs that ``watch`` wrote into ``folder``; ``dt`` in s.

    Raises ValueError if there are none.
    """
    records = []
    for file in run_files(folder):
        reference, measured, voltage = load_samples(file)
        records.append(
            Record(voltage, measured, dt, source=file.name, reference=reference)
        )
    if not records:
        raise ValueError(f"{folder} holds no runs of a watch")
    return records


def watch(
    stage: Stage,
    gains: Gains,
    motion: Motion,
    folder: Path,
    *,
    baseline: Path | None = None,
    runs: int = 3,
    false_alarms: float = FALSE_ALARMS,
    name: str = "stage",
    progress: Progress | None = None,
) -> WatchReport:
    """Run ``motion`` on ``stage`` and judge whether the stage has changed.

    ``runs`` runs are compared with those in the folder ``baseline``. Without one, they
    become a baseline themselves, after a run that does not count. ``folder`` receives
    the samples of every run that counts or is stopped, and the report. The stage keeps
    ``gains``; it is made safe after a failure. Raises ValueError for a ``baseline`` of
    another reference, of other gains, without its report or with too few runs.
    """
    known = None
    if baseline is not None:
        known = Baseline(read_runs(baseline, stage.dt), motion.start)
        _check_gains(baseline, gains)
    elif runs < FEATURES + 2:
        raise ValueError(
            f"a baseline needs at least {FEATURES + 2} runs, not {runs}; give more "
            "runs, or the folder of a baseline"
        )
    try:
        records, judged = _runs(
            stage, gains, motion, folder, known, runs, false_alarms, progress
        )
    except BaseException:
        # The first error says what went wrong.
        with contextlib.suppress(StageError):
            stage.safe()
        raise
    if known is None and len(records) == runs:
        known = Baseline(records, motion.start)
    report = WatchReport(
        stage=name,
        reference=motion.name,
        gains=dict(gains),
        false_alarms=false_alarms,
        baseline=known.features if known else [],
        runs=judged,
        alarms=[sentence for each in judged if (sentence := _alarm(each))],
    )
    write_report(folder / WATCH_FILE, report)
    return report


def _check_gains(baseline: Path, gains: Gains) -> None:
    """Raise ValueError if the runs in ``baseline`` were made with other ``gains``."""
    report = read_model(
        WatchReport, baseline / WATCH_FILE, "is not the report of a watch"
    )
    known = report.gains
    differing = [
        f"{path} is {gains.get(path, 'not set')} now and was "
        f"{known.get(path, 'not set')}"
        for path in sorted({*gains, *known})
        if not math.isclose(gains.get(path, math.nan), known.get(path, math.nan))
    ]
    if differing:
        raise ValueError(
            f"{baseline} was recorded with other gains: {'; '.join(differing)}; record "
            "a baseline with the present gains"
        )


def _runs(
    stage: Stage,
    gains: Gains,
    motion: Motion,
    folder: Path,
    known: Baseline | None,
    runs: int,
    false_alarms: float,
    progress: Progress | None,
) -> tuple[list[Record], list[Judgement]]:
    """Run ``motion`` and compare each run with ``known``; end at a stopped run."""
    progress = progress or Silent()
    progress.stage("running the reference on the stage", runs)
    records, judged = [], []
    file = folder / "first.npz"
    try:
        if known is None:  # the first motion differs from those that follow it
            stage.run(motion.reference, gains)
        for number in range(1, runs + 1):
            file = run_file(folder, number)
            record = stage.run(motion.reference, gains)
            save_samples(file, motion.reference, record.output, record.input)
            records.append(record)
            if known is not None:
                found = known.judge(record, false_alarms)
                judged.append(found.model_copy(update={"file": file.name}))
            progress.advance(float(number), f"run {number} of {runs}")
    except StoppedError as stop:
        save_samples(file, stop.reference, stop.measured, stop.voltage)
        judged.append(Judgement(file=file.name, stopped=stop.reason))
    return records, judged


def _alarm(judged: Judgement) -> str:
    """Return the alarm about a run, "" if the stage has not changed."""
    if judged.stopped:
        return f"{judged.file}: the run was stopped: {judged.stopped}"
    if not judged.moved or judged.features is None:
        return ""
    features = judged.features
    return (
        f"{judged.file}: the stage has changed: its gain by "
        f"{features.gain_percent:+.2g} %, its lag by {features.lag_us:+.2g} us "
        f"(T^2 {judged.distance:.3g}, threshold {judged.threshold:.3g}); record it "
        "again, identify and tune"
    )
