"""Report of a retuning: the gains that were tried, and what they did."""

import math
from typing import Literal

from pydantic import BaseModel

from ..stages import TriedRun

RETUNE_FILE = "retune.json"

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

    ``title`` is that of the study. ``before`` are all gains of the stage before,
    ``units`` their units by path. The ``attempts`` begin with gains that were on the
    stage. ``best`` is the place of those that are set at the end; None if these are the
    safe gains. ``verdict`` is "done", "stopped" (the user or a fault ended it: the safe
    gains are set) or "lost" (no connection); "running" until then.
    """

    stage: str
    title: str
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
    def improved(self) -> bool:
        """Whether the best gains are others than those of the first attempt."""
        return self.best is not None and self.best > 0

    @property
    def tuned(self) -> bool:
        """Whether tuned gains were run; the first show what the start hides."""
        return any(each.model and each.verdict != "not tried" for each in self.attempts)

    @property
    def ratio(self) -> float:
        """Error at the beginning relative to the best one; infinite if a run with these
        gains was stopped."""
        return self.attempts[0].error / self.best_error if self.attempts else math.nan
