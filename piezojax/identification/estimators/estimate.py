"""Options and results common to all methods of identification."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import BaseModel

from ...core.system import System
from ...dynamics import StateSpace
from ..held_dynamics import HeldDynamics
from .frequency import EmpiricalResponse
from .resonances import LinearDynamics

if TYPE_CHECKING:
    from ..known_plant import KnownPlant
    from ..second_sight import Begun


class FittedParameter(BaseModel):
    """A fitted value and its standard error, in the parameter's own unit."""

    value: float
    standard_error: float | None


EDGE = 1e-3
"""Distance, as a share of the range, within which a parameter is at a bound."""


def bound_warning(name: str, place: float) -> list[str]:
    """Return a warning if ``place``, from 0 to 1 in the range, is at a bound."""
    inside = EDGE <= place <= 1.0 - EDGE
    return [] if inside else [f"{name} lies at the edge of its bounds"]


@dataclass(frozen=True)
class Options:
    """Options of the methods; each method uses those that concern it.

    ``order`` is the number of states of a linear model, ``window`` the number p of past
    and future samples in the Hankel-Toeplitz regression, ``oversample`` the number of
    simulated samples per sample of a periodic record, ``steps`` the largest number of
    steps of a descent. ``dynamics`` are held fixed in the fit of a chain.
    ``closed_loop`` is one of ``closed_loop.APPROACHES`` to a record of a closed loop,
    by default chosen from the record; ``controller`` is the controller that closed it,
    for ``indirect``. ``known`` is a plant that is fitted again. ``begun`` is a fit to
    several records that goes on, if the choice of the model has made one.
    """

    order: int = 4
    window: int = 20
    oversample: int = 8
    steps: int = 200
    dynamics: HeldDynamics | None = None
    closed_loop: str | None = None
    controller: System | None = None
    known: "KnownPlant | None" = None
    begun: "Begun | None" = None


class LinearDetail(NamedTuple):
    """Data for the plots of a linear model.

    ``singular_values`` are by input (or "" for all inputs); ``order`` of them are kept.
    ``measured`` is the transfer matrix that ``model`` was fitted to, if any.
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
    """A fitted system, its free run over every record [samples, p], and warnings.

    ``order`` is the number of parameters of linear dynamics that the records had to
    excite. ``hysteresis`` is True if the records also had to hold full cycles.
    ``count`` is the number of fitted parameters if ``parameters`` does not name all;
    of weights it counts those that the records determine.
    ``closed_loop`` says how a record of a closed loop was fitted. ``shown`` are the
    linear dynamics that showed in the fit, if it looked at them again.
    """

    system: System
    simulations: tuple[np.ndarray, ...]
    parameters: dict[str, FittedParameter]
    warnings: list[str]
    order: int = 0
    hysteresis: bool = False
    linear: LinearDetail | None = None
    count: int | None = None
    closed_loop: str = ""
    shown: LinearDynamics | None = None

    def parameter_count(self) -> int:
        """Return the number of fitted parameters."""
        return len(self.parameters) if self.count is None else self.count
