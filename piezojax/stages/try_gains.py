"""Trial of tuned gains on a stage: small motions first, then the references."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from ..core.files import write_report
from ..core.progress import Progress, Silent
from ..identification import Record
from .protocol import Gains, LostError, Stage, StageError, StoppedError
from .run_files import run_file, save_samples

TRIAL_FILE = "trial.json"

SMALL = (0.1, 0.3)
"""Shares of the first reference with which a trial begins."""

NEAR, FAR = 1.3, 2.0
"""Ratios of the measured to the promised error above which there is a note, and above
which the gains are not kept."""

Verdict = Literal["running", "kept", "restored", "stopped", "lost"]


@dataclass(frozen=True)
class Motion:
    """Reference of a run: ``reference`` (um) and the error ``promised`` (um rms).

    Samples before ``start`` do not count. ``noise`` is the rms noise of the sensor, um:
    it is part of the measured error, but not of the promised one. ``promised`` is None
    if no error is.
    """

    name: str
    reference: Float[np.ndarray, " samples"]
    promised: float | None
    start: int = 0
    noise: float = 0.0


class TriedRun(BaseModel):
    """Run of a trial with a ``share`` of a reference.

    ``measured_um`` is the rms of reference minus reading, and ``peak_um`` its largest
    absolute value. ``error_um`` is the rms without the noise of the sensor: the noise
    power subtracted is its mean plus three standard deviations over so many samples.
    All three are None if the run was stopped, for the reason ``stopped``. ``file``
    holds the samples.
    """

    reference: str
    share: float
    promised_um: float | None = None
    measured_um: float | None = None
    error_um: float | None = None
    peak_um: float | None = None
    voltage_V: tuple[float, float] | None = None  # noqa: N815
    stopped: str = ""
    file: str = ""

    @property
    def ratio(self) -> float:
        """Error relative to the promised one; infinite if one of them is not known."""
        if self.error_um is None or self.promised_um is None:
            return math.inf
        return self.error_um / self.promised_um


class TrialReport(BaseModel):
    """Report of a trial, the content of ``trial.json``.

    ``gains`` are those tried, ``before`` all gains of the stage before the trial.
    ``verdict`` is "kept", "restored" (the gains from before are set again), "stopped"
    (the guard or the user stopped a run: the safe gains are set), or "lost" (no
    connection, or the safe gains could not be set). While the trial runs it is
    "running".
    """

    stage: str
    gains: dict[str, float]
    before: dict[str, float]
    runs: list[TriedRun] = []
    verdict: Verdict = "running"
    alarms: list[str] = []
    notes: list[str] = []


def trial(
    stage: Stage,
    gains: Gains,
    motions: Sequence[Motion],
    folder: Path,
    *,
    name: str = "stage",
    progress: Progress | None = None,
) -> TrialReport:
    """Try ``gains`` on ``stage``; keep them if no error is much larger than promised.

    The gains of the stage are saved first. The stage then follows the shares ``SMALL``
    of the first of ``motions``, and all ``motions``. The trial ends at a run that is
    stopped, after which the stage has its safe gains, or at a run whose error exceeds
    FAR times the promised one, after which the gains from before are set. ``folder``
    receives the samples of every run, and the report after each step.

    Raises ValueError if there is no motion, one of them has no promised error, or the
    stage lacks one of the gains.
    """
    if not motions:
        raise ValueError("a trial needs at least one reference")
    for motion in motions:
        if motion.promised is None:
            raise ValueError(f"{motion.name} has no promised error to compare with")
    progress = progress or Silent()
    report = TrialReport(stage=name, gains=dict(gains), before=stage.gains())
    missing = [path for path in gains if path not in report.before]
    if missing:
        raise ValueError(
            f"the stage has no gain {missing[0]}; it has {', '.join(report.before)}"
        )
    file = folder / TRIAL_FILE
    write_report(file, report)
    first = [(motions[0], share) for share in SMALL]
    planned = first + [(motion, 1.0) for motion in motions]
    progress.stage("trying the gains on the stage", len(planned))
    with safe_after_failure(stage, report, file):
        for number, (motion, share) in enumerate(planned, start=1):
            samples = run_file(folder, number)
            run, _ = tried(stage, gains, motion, share, samples)
            report.runs.append(run)
            write_report(file, report)
            if run.stopped or run.ratio > FAR:
                break
            progress.advance(
                run.ratio, f"{_named(run)}: {run.ratio:.2f} of the promised error"
            )
        _judge(stage, report)
    return report


@contextlib.contextmanager
def safe_after_failure(stage: Stage, report: Any, file: Path) -> Iterator[None]:
    """Context for work on ``stage`` that writes ``report`` to ``file`` at its end.

    If the work fails, the stage is made safe, and ``report`` receives the verdict and
    an alarm. A StageError ends here; other errors are raised again.
    """
    try:
        yield
    except BaseException as error:
        report.verdict, alarm = abandoned(stage, error)
        report.alarms.append(alarm)
        if not isinstance(error, StageError):
            raise
    finally:
        write_report(file, report)


def tried(
    stage: Stage,
    gains: Gains,
    motion: Motion,
    share: float,
    file: Path,
    command: Float[np.ndarray, " samples"] | None = None,
) -> tuple[TriedRun, Float[np.ndarray, " samples"] | None]:
    """Run a ``share`` of ``motion`` with ``gains``; write its samples into ``file``.

    The stage follows ``command`` (um) instead of the motion if it is given; errors are
    relative to the motion. Returns the run and its readings (um). A run that is
    stopped has the reason, no error and no readings. Raises as ``Stage.run`` does in
    other cases.
    """
    begin = motion.reference[0]
    reference = begin + share * (motion.reference - begin)
    run = TriedRun(
        reference=motion.name, share=share, promised_um=motion.promised, file=file.name
    )
    try:
        record = stage.run(reference if command is None else command, gains)
    except StoppedError as stop:
        known = reference[: len(stop.measured)]
        save_samples(file, known, stop.measured, stop.voltage)
        return run.model_copy(update={"stopped": stop.reason}), None
    save_samples(file, reference, record.output, record.input)
    figures = _figures(record, reference, motion)
    return run.model_copy(update=figures), record.output


def _figures(record: Record, reference: np.ndarray, motion: Motion) -> dict:
    error = (reference - record.output)[motion.start :]
    measured = float(np.sqrt(np.mean(error**2)))
    voltage = record.input
    noise = motion.noise**2 * (1.0 + 3.0 * math.sqrt(2.0 / error.size))
    return {
        "measured_um": measured,
        "error_um": math.sqrt(max(measured**2 - noise, 0.0)),
        "peak_um": float(np.abs(error).max()),
        "voltage_V": (float(voltage.min()), float(voltage.max())),
    }


def _judge(stage: Stage, report: TrialReport) -> None:
    """Keep the gains, or restore those from before, by the runs of ``report``."""
    last = report.runs[-1]
    if last.stopped:
        stage.safe()
        report.verdict = "stopped"
        report.alarms.append(
            f"{_named(last)}: {last.stopped}; the safe gains of the stage are set"
        )
    elif last.ratio > FAR:
        stage.apply(report.before)
        report.verdict = "restored"
        report.alarms.append(
            f"{_named(last)}: the error is {last.error_um:.3g} um, {last.ratio:.3g} "
            f"times the promised {last.promised_um:.3g} um; the gains from before are "
            "set again. The model does not describe this stage: record it with these "
            "runs, identify it again and tune"
        )
    else:
        report.verdict = "kept"
        report.notes += [
            f"{_named(run)}: the error is {run.ratio:.3g} times the promised one"
            for run in report.runs
            if run.ratio > NEAR
        ]


def abandoned(
    stage: Stage, error: BaseException
) -> tuple[Literal["stopped", "lost"], str]:
    """Make ``stage`` safe after ``error`` if possible; return verdict and alarm."""
    cause = _cause(error)
    if not isinstance(error, LostError):
        try:
            stage.safe()
        except Exception as refusal:
            cause = f"{cause}; the safe gains could not be set: {_cause(refusal)}"
        else:
            return "stopped", f"{cause}; the safe gains of the stage are set"
    return "lost", (
        f"{cause}: nothing is known of the stage since then; only a guard of its own "
        "can make it safe. Look at it before the next run"
    )


def _cause(error: BaseException) -> str:
    return str(error) or type(error).__name__


def _named(run: TriedRun) -> str:
    return f"{run.reference} at {100.0 * run.share:g} %"
