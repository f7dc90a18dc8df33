"""Iterative learning control on a stage: the reference of a motion is corrected."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float
from pydantic import BaseModel

from ..analysis.stability.operating_point import OperatingPoint
from ..analysis.stability.small_motion import lines, references_followed, sensitivities
from ..core.error_bound import ErrorBound
from ..core.feedback import Feedback
from ..core.files import write_report, write_text
from ..core.progress import Progress, Silent
from .protocol import Gains, Stage
from .run_files import run_file
from .try_gains import Motion, TriedRun, safe_after_failure, tried

LEARN_FILE, LEARNED_FILE, TABLE_FILE = "learn.json", "learned.csv", "table.csv"

ASSUMED = 0.3
"""Assumed relative error of a plant without an error bound from its record."""

TRUSTED = 0.5
"""Relative error of the closed loop at which half of an error is corrected."""

LARGEST = 2.0
"""Largest correction of an error at one frequency, as a multiple of it."""

REACH = 0.1
"""Largest correction, as a share of the range of the motion."""

ABOVE = 3.0
"""Ratio of the power of a line to the mean power of noise, above which the noise alone
lies in 5 % of the lines."""

RISE = 0.02
"""Share of the motion at the beginning over which a correction rises from 0."""

PATIENCE = 2
"""Number of runs in a row without an improvement after which the learning ends."""

GAINED = 0.98
"""Ratio of two errors below which the smaller one is an improvement."""


class LearnReport(BaseModel):
    """Report on the learning of a reference, the content of ``learn.json``.

    ``gains`` are those during the runs, ``before`` all gains of the stage before, which
    are set again at the end. Run 1 follows the ``reference`` itself. ``best`` is the
    index of the run with the smallest error, None if none was completed. ``verdict`` is
    "done", "stopped" (a run was stopped, or the user ended it: the safe gains are set)
    or "lost" (no connection, or the safe gains could not be set); "running" until then.
    """

    stage: str
    reference: str
    gains: dict[str, float]
    before: dict[str, float]
    runs: list[TriedRun] = []
    best: int | None = None
    verdict: Literal["running", "done", "stopped", "lost"] = "running"
    alarms: list[str] = []
    notes: list[str] = []

    @property
    def ratio(self) -> float:
        """Error of the first run relative to the smallest one."""
        if self.best is None:
            return math.nan
        first, best = self.runs[0].measured_um, self.runs[self.best].measured_um
        return (first or math.nan) / (best or math.nan)


@dataclass(frozen=True)
class LearningFilter:
    """Filter from the error of a run to the correction of its reference.

    ``gain`` is its complex response at ``frequency`` (Hz).
    """

    frequency: Float[np.ndarray, " lines"]
    gain: Complex[np.ndarray, " lines"]

    def correction(
        self, error: Float[np.ndarray, " samples"], dt: float, noise: float = 0.0
    ) -> Float[np.ndarray, " samples"]:
        """Return the correction (um) for the ``error`` (um) of a run.

        Outside the run the error counts as 0. Each line is multiplied by 1 - ABOVE n/p,
        but at least 0, where p is its power and n that of white ``noise`` (um rms).
        """
        samples = len(error)
        padded = 1 << (2 * samples - 1).bit_length()
        at = np.fft.rfftfreq(padded, dt)
        parts = (
            np.interp(at, self.frequency, part)
            for part in (np.real(self.gain), np.imag(self.gain))
        )
        real, imaginary = parts
        spectrum = np.fft.rfft(error, padded)
        floor = ABOVE * noise**2 * samples / np.maximum(np.abs(spectrum) ** 2, 1e-300)
        spectrum *= np.clip(1.0 - floor, 0.0, 1.0) * (real + 1j * imaginary)
        return np.fft.irfft(spectrum, padded)[:samples]


def learning_filter(
    loop: Feedback,
    highest: float,
    dt: float,
    bound: ErrorBound | None = None,
    duration: float | None = None,
) -> LearningFilter:
    """Return the filter of ``loop``, an inverse as far as its plant is known.

    T is the response of the displacement to the reference, for small motions at the
    reference ``highest`` (um), averaged over both branches of the hysteresis. An error
    e is corrected by e / T. If the plant has the relative error d, that of T is |S| d,
    and |S| d e remains of e after a run. The correction is therefore multiplied by
    1 / (1 + (|S| d / TRUSTED)^2), and limited to LARGEST times the error. d is
    ``bound``, or ASSUMED without one. ``duration`` (s) is that of ``sensitivity``. For
    one axis.
    """
    point = OperatingPoint(np.asarray(highest), dt=dt)
    followed = np.mean(np.asarray(references_followed(loop, point, duration)), axis=0)
    sensitivity = np.abs(np.asarray(sensitivities(loop, point, duration))[..., 0, 0])
    at = lines(dt, duration)
    unknown = np.full(len(at), ASSUMED) if bound is None else bound.at(at)
    left = np.max(sensitivity, axis=0) * unknown
    trust = 1.0 / (1.0 + (left / TRUSTED) ** 2)
    size = np.minimum(trust / np.maximum(np.abs(followed), 1e-12), LARGEST)
    return LearningFilter(at, size * np.exp(-1j * np.angle(followed)))


def learn_reference(
    stage: Stage,
    gains: Gains,
    motion: Motion,
    law: LearningFilter,
    folder: Path,
    *,
    runs: int,
    points: int | None = None,
    name: str = "stage",
    progress: Progress | None = None,
) -> LearnReport:
    """Repeat ``motion`` on ``stage``, and correct its reference after each run.

    The stage runs with ``gains``. Learning ends after ``runs`` runs, or when the error
    does not fall any more. Then the gains from before are set, but the safe ones after
    a run that was stopped or a failure. ``folder`` receives the samples of every run
    (with the motion as its reference), the best reference in ``learned.csv``, the same
    as a table of at most ``points`` points in ``table.csv``, and the report after each
    run.

    Raises as ``Stage.run`` does for gains that the stage does not have.
    """
    progress = progress or Silent()
    report = LearnReport(
        stage=name, reference=motion.name, gains=dict(gains), before=stage.gains()
    )
    file = folder / LEARN_FILE
    write_report(file, report)
    progress.stage(f"learning {motion.name} on the stage", runs)
    with safe_after_failure(stage, report, file):
        _repeat(stage, motion, law, folder, report, runs, points, progress)
        if report.verdict == "running":
            stage.apply(report.before)
            report.verdict = "done"
    return report


def _repeat(
    stage: Stage,
    motion: Motion,
    law: LearningFilter,
    folder: Path,
    report: LearnReport,
    runs: int,
    points: int | None,
    progress: Progress,
) -> None:
    wanted = motion.reference
    largest, worse = REACH * float(np.ptp(wanted)), 0
    rise = np.clip(np.arange(len(wanted)) / (RISE * len(wanted)), 0.0, 1.0)
    rise = 0.5 - 0.5 * np.cos(np.pi * rise)
    command = wanted
    smallest = math.inf
    while len(report.runs) < runs and worse < PATIENCE:
        file = run_file(folder, len(report.runs) + 1)
        run, measured = tried(stage, report.gains, motion, 1.0, file, command)
        report.runs.append(run)
        write_report(folder / LEARN_FILE, report)
        if run.stopped or run.measured_um is None or measured is None:
            stage.safe()
            report.verdict = "stopped"
            report.alarms.append(
                f"run {len(report.runs)}: {run.stopped}; the safe gains of the stage "
                "are set"
            )
            return
        progress.advance(
            run.measured_um, f"{motion.name}: {1e3 * run.measured_um:.3g} nm rms"
        )
        worse = 0 if run.measured_um < GAINED * smallest else worse + 1
        if run.measured_um < smallest:
            smallest, report.best = run.measured_um, len(report.runs) - 1
            _write_learned(folder, stage.dt, wanted, command, points)
        change = law.correction(wanted - measured, stage.dt, motion.noise)
        learned = command - wanted + rise * change
        if np.max(np.abs(learned)) > largest and not report.notes:
            report.notes.append(
                f"corrections are cut at {largest:.4g} um, a tenth of the motion"
            )
        command = wanted + np.clip(learned, -largest, largest)


def _write_learned(
    folder: Path,
    dt: float,
    wanted: np.ndarray,
    command: np.ndarray,
    points: int | None,
) -> None:
    """Write the motion with the learned reference, and the latter in ``points``.

    A waveform generator holds each point; all times are multiples of ``dt``.
    """
    both = np.stack([wanted, command])
    tables = [(LEARNED_FILE, "time_s,motion_um,reference_um", both, 1)]
    if points is not None:
        hold = math.ceil(len(command) / points)
        tables.append((TABLE_FILE, "time_s,reference_um", command[None], hold))
    for name, head, columns, hold in tables:
        rows = (
            ",".join([f"{dt * hold * k:.9g}", *(f"{value:.7g}" for value in row)])
            for k, row in enumerate(columns[:, ::hold].T)
        )
        write_text(folder / name, "\n".join([head, *rows]) + "\n")
