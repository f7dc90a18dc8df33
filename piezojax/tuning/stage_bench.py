"""Runs of a retuning: a small motion and the references, with their records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.files import write_report
from ..core.progress import Progress
from ..identification import Record
from ..stages import Motion, Stage, TriedRun
from ..stages.probe import probe
from ..stages.run_files import load_samples, run_file
from ..stages.try_gains import tried
from .attempts import RETUNE_FILE, Attempt, RetuneReport

PROBE = "small motion"
"""Name of the small motion in the list of runs."""

RINGING = 2.0
"""Ratio of the rms error in the small motion to the standard deviation of its reference
above which the loop rings: a sensitivity peak of 2 allows no more."""

FITTED, SHORTEST = 4, 400
"""Number of last runs to which the plant is fitted, and the fewest samples of such a
run."""


@dataclass
class Bench:
    """Stage with the runs of a retuning, at most ``budget`` of them."""

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
        write_report(self.folder / RETUNE_FILE, self.report)

    def measure(self, attempt: Attempt) -> None:
        """Run a small motion and the references with the gains of ``attempt``."""
        self.report.attempts.append(attempt)
        errors = []
        for motion in (small_motion(self.motions[0]), *self.motions):
            found = self.run(attempt.gains, motion)
            stopped = found.stopped
            if motion.name == PROBE and _rings(found, motion):
                self.stage.safe()  # the guard did not stop it
                stopped = "the loop rings"
            if stopped or found.measured_um is None:
                stopped = stopped or "the run has no measured error (measured_um)"
                attempt.verdict, attempt.why = "stopped", f"{motion.name}: {stopped}"
                return
            errors.append(found.measured_um)
        attempt.measured_um = geometric_mean(errors[1:])
        attempt.verdict = "measured"

    def run(
        self, gains: Mapping[str, float], motion: Motion, share: float = 1.0
    ) -> TriedRun:
        """Follow a ``share`` of ``motion`` with ``gains``."""
        runs = self.report.runs
        self.progress.stage(f"run {len(runs) + 1} of {self.budget}: {motion.name}")
        file = run_file(self.folder, len(runs) + 1)
        found, _ = tried(self.stage, gains, motion, share, file)
        runs.append(found)
        self.write()
        return found

    def restore(self) -> None:
        """Set the best gains, or the safe ones if no gains followed the references."""
        if self.report.best is None:
            self.stage.safe()
        else:
            self.stage.apply(self.report.attempts[self.report.best].gains)

    def records(self) -> list[list[Record]]:
        """Return the records of the last runs, and those of the last complete runs.

        Complete runs are those that were not stopped. Equal sets are returned once. A
        record ends at its first missing number.
        """
        runs = self.report.runs
        sets = runs[-FITTED:], [run for run in runs if not run.stopped][-FITTED:]
        # A run that is too short for a record is in neither set.
        found = {
            tuple(record.source for record in records): records
            for each in sets
            if (records := [*filter(None, map(self._record, each))])
        }
        return [*found.values()]

    def small(self, records: Sequence[Record]) -> list[Record]:
        """Return those of ``records`` that are of small motions."""
        files = {run.file for run in self.report.runs if run.reference == PROBE}
        return [record for record in records if record.source in files]

    def _record(self, run: TriedRun) -> Record | None:
        """Return the record of ``run``, or None if it is too short or does not move."""
        columns = np.stack(load_samples(self.folder / run.file))
        known = np.cumprod(np.isfinite(columns).all(axis=0)).astype(bool)
        reference, measured, voltage = columns[:, known]
        if len(measured) < SHORTEST or 0.0 in (np.ptp(measured), np.ptp(voltage)):
            return None
        about = {"source": run.file, "reference": reference}
        return Record(voltage, measured, self.stage.dt, **about)


def small_motion(motion: Motion) -> Motion:
    """Return the small motion before ``motion``."""
    return Motion(PROBE, probe(motion.reference), None, motion.start, motion.noise)


def _rings(run: TriedRun, motion: Motion) -> bool:
    """Return whether the error of a ``run`` is too large for its small ``motion``."""
    return (run.measured_um or 0.0) > RINGING * float(np.std(motion.reference))


def geometric_mean(errors: Sequence[float]) -> float:
    """Return the geometric mean of ``errors`` (um)."""
    return float(np.exp(np.mean(np.log(np.maximum(errors, 1e-12)))))
