"""Report of a retuning: the gains tried, with predicted and measured errors."""

import math
from typing import Literal

from pydantic import BaseModel

from ..stages import TriedRun

RETUNE_FILE = "retune.json"

AttemptVerdict = Literal[
    "running", "measured", "better", "not better", "stopped", "not tried"
]


class Attempt(BaseModel):
    """One set of gains in a retuning, with its predicted and measured errors.

    ``gains`` are the gains of the stage by path. ``model`` is the file of the plant on
    which they were tuned, "" for gains that were on the stage already. ``within`` is
    the largest factor allowed between a tuned gain and the best one before, None if
    there was none. ``predicted_um`` and ``measured_um`` are rms errors with the noise
    of the sensor, geometric means over the references; None if they are not known.
    ``why`` tells why the gains were stopped or not tried.
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

    ``title`` is that of the study. ``before`` holds all gains of the stage before the
    retuning, ``units`` the units of gains by path. The ``attempts`` begin with the
    gains that were on the stage. ``best`` is the index of the best attempt, None if no
    gains followed the references. ``verdict`` is "done", "stopped" (the user or a fault
    ended the retuning: the safe gains are set) or "lost" (no connection, or the safe
    gains could not be set); "running" until then.
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
        """Whether the best attempt is not the first one."""
        return self.best is not None and self.best > 0

    @property
    def tuned(self) -> bool:
        """Whether tuned gains were run.

        The first ones are run whatever their prediction: their runs may show dynamics
        that those of the start hide.
        """
        return any(each.model and each.verdict != "not tried" for each in self.attempts)

    @property
    def ratio(self) -> float:
        """Error of the first attempt relative to the best one; infinite if the first
        attempt was stopped."""
        return self.attempts[0].error / self.best_error if self.attempts else math.nan
