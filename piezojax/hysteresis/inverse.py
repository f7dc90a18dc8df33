"""What the inverses of hysteresis models share."""

import abc
from typing import TYPE_CHECKING, Any

import equinox as eqx

from .._types import Scalar, ScalarLike, State
from ..system import System


class InverseHysteresis(System):
    """The voltage that moves ``model`` to a wanted output: um to V.

    The state is the model's own, so that a controller whose voltage was clipped can
    advance it with the voltage that was really applied.
    """

    if TYPE_CHECKING:  # else a checker wants every model to be any System

        @property
        def model(self) -> System: ...

    else:
        model: eqx.AbstractVar[System]

    @abc.abstractmethod
    def solve(self, state: State, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        voltage = self.solve(state, input)
        return self.model.step(state, voltage)[0], voltage
