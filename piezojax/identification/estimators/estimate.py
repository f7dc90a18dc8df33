"""What every method of identification takes and gives."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

from ...core.system import System
from ...dynamics import StateSpace
from .frequency import EmpiricalResponse


class FittedParameter(BaseModel):
    """A fitted value and its standard error, in the parameter's own unit."""

    value: float
    standard_error: float | None


EDGE = 1e-3
"""How close to a bound, as a share of the range, a parameter lies at it."""


def at_edge(name: str, place: float) -> list[str]:
    """Return what to say of a parameter at ``place``, 0 to 1, in its range."""
    inside = EDGE <= place <= 1.0 - EDGE
    return [] if inside else [f"{name} lies at the edge of its bounds"]


@dataclass(frozen=True)
class Options:
    """What the methods may be told; each uses what it needs.

    ``order``: states of a linear model; ``window``: p, the past and future samples of
    the Hankel-Toeplitz regression; ``oversample``: simulated samples for each of a
    periodic record; ``steps``: most steps of a descent.
    """

    order: int = 4
    window: int = 20
    oversample: int = 8
    steps: int = 200


class LinearDetail(NamedTuple):
    """What the pictures of a linear model show.

    ``singular_values`` by input (or "" for all), of which ``order`` are kept;
    ``measured``: the transfer matrix that ``model`` was fitted to, if one was.
    """

    model: StateSpace
    order: int
    singular_values: dict[str, np.ndarray]
    measured: EmpiricalResponse | None = None

    def fitted(self) -> np.ndarray:
        """Return the response of ``model`` [lines, p, m] at the measured frequencies.

        Raises ValueError if no response was measured.
        """
        if self.measured is None:
            raise ValueError("no frequency response was measured")
        return np.asarray(self.model.frequency_response(self.measured.frequency))


class Estimate(NamedTuple):
    """A fitted system, its free run over every record [samples, p], what to say.

    ``order`` counts the parameters of linear dynamics that the records had to excite,
    ``hysteresis`` tells whether they also had to show full cycles. ``count``: how many
    parameters were fitted, where ``parameters`` does not name them all.
    """

    system: System
    simulations: tuple[np.ndarray, ...]
    parameters: dict[str, FittedParameter]
    warnings: list[str]
    order: int = 0
    hysteresis: bool = False
    linear: LinearDetail | None = None
    count: int | None = None

    def counted(self) -> int:
        """Return how many parameters were fitted."""
        return len(self.parameters) if self.count is None else self.count
