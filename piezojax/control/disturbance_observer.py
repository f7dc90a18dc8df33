"""Disturbance observer (DOB) with its Q-filter, around any controller."""

import itertools
from typing import ClassVar, NamedTuple

import equinox as eqx

from ..core.arrays import Scalar, State, as_array, check_not_zero
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter, sample_time
from ..core.system import System
from ..dynamics.arma import ARMA
from .output_tracking import Row

COEFFICIENTS = ("corrected", "printed")


class DisturbanceObserverState(NamedTuple):
    """State of the controller, the last estimate w, and the memory of the filter.

    ``memory`` holds the contributions of past samples to c_0 w one, two, ... samples
    later, in V: the transposed direct form of (5.26), which has the fewest states.
    """

    feedback: State
    disturbance: Scalar
    memory: Row


class DisturbanceObserverControl(System):
    """``u = f / gain - w``: f from ``feedback``, w the estimated disturbance.

    Figure 5.2, (5.26)-(5.32): w = Q/(gain G) z - Q u, where G is ``model``
    of any order (a_1, ..., a_n | b_0, b_1, ..., DC gain near 1), ``gain`` K_e is the
    linear part of the hysteresis, and Q has G's zeros, unit DC gain and n equal poles
    at ``cutoff``, two for the second order of the thesis. u is the applied voltage,
    after the limits. ``feedback`` receives gain (u + w) in um as its applied command.

    ``coefficients`` is ``"corrected"`` (poles by the bilinear transform) or
    ``"printed"`` ((5.32) as printed, for n = 2, whose poles lie at -0.54 and -7.46
    times the cut-off). Input an Observation, output in V.

    Raises ValueError for a model of one coefficient or with DC gain 0, for unknown
    ``coefficients``, and for "printed" ones of an order other than 2.
    """

    part_units: ClassVar[PartUnits] = {"feedback": {"u": "um"}}

    feedback: System
    model: ARMA
    gain: Scalar = parameter(
        "um/V",
        "linear gain K_e of the hysteresis",
        above=0.0,
        scale="log",
    )
    cutoff: Scalar = parameter(
        "rad/s",
        "cut-off frequency of the Q-filter",
        above=0.0,
        below_nyquist=True,
        scale="log",
        typical=(1.0, 1e5),
    )
    dt: float = sample_time()
    coefficients: str = eqx.field(static=True, default="corrected")

    def __check_init__(self):
        check_not_zero("DC gain of the model", sum(self.model.moving))
        if self.coefficients not in COEFFICIENTS:
            raise ValueError(
                f"coefficients {self.coefficients!r}; "
                f"it must be one of {list(COEFFICIENTS)}"
            )
        if self.order < 1:
            raise ValueError("the model is a gain; it must have an order of at least 1")
        if self.coefficients == "printed" and self.order != 2:
            raise ValueError(
                f"the model has the order {self.order}; printed coefficients need 2"
            )

    @property
    def order(self) -> int:
        """Order n of the model and of the Q-filter."""
        return max(len(self.model.autoregressive), len(self.model.moving) - 1)

    def denominator(self) -> Row:
        """Return c_0, ..., c_n of the Q-filter (5.32).

        They are the coefficients of ((1 + 1/z)/2 + (1 - 1/z)/(cutoff dt))^n, scaled to
        unit DC gain.
        """
        x = 1.0 / (self.cutoff * self.dt)
        total = sum(self.model.moving)
        if self.coefficients == "printed":
            square = x**2 / 4.0
            return (
                (0.25 + square + x) * total,
                (0.5 - 2.0 * square) * total,
                (0.25 + square - x) * total,
            )
        found = (as_array(total),)
        for _ in range(self.order):
            last = (*found, 0.0), (0.0, *found)
            found = tuple(
                (0.5 + x) * a + (0.5 - x) * b for a, b in zip(*last, strict=True)
            )
        return found

    def init(self, input: Observation) -> DisturbanceObserverState:
        # At rest Q = 1: w = z / (gain G(1)) - u.
        w = input.measured / (self.gain * self.model.dc_gain()) - input.applied
        applied_f = self.gain * (input.applied + w)
        # At rest each element of the memory is the sum of its own and all later terms.
        terms = itertools.accumulate(reversed(self._past(input, w)))
        return DisturbanceObserverState(
            feedback=self.feedback.init(input._replace(applied=applied_f)),
            disturbance=w,
            memory=tuple(terms)[::-1],
        )

    def _past(self, input: Observation, w: Scalar) -> Row:
        """Return the contributions of a sample to c_0 w one, two, ... samples later."""
        z, u = input.measured / self.gain, input.applied
        return tuple(
            -a * z - b * u - c * w
            for a, b, c in zip(
                _padded(self.model.autoregressive, self.order),
                _padded(self.model.moving[1:], self.order),
                self.denominator()[1:],
                strict=True,
            )
        )

    def step(
        self, state: DisturbanceObserverState, input: Observation
    ) -> tuple[DisturbanceObserverState, Scalar]:
        c0 = self.denominator()[0]
        z, u = input.measured / self.gain, input.applied
        # Both filters of (5.26) have the denominator c, hence one recursion for both.
        w = (1.0 / c0) * (z - self.model.moving[0] * u + state.memory[0])
        *terms, last = self._past(input, w)
        later = zip(terms, state.memory[1:], strict=True)
        memory = (*(new + old for new, old in later), last)
        applied_f = self.gain * (u + state.disturbance)
        observation = input._replace(applied=applied_f)
        feedback, f = self.feedback.step(state.feedback, observation)
        state = DisturbanceObserverState(feedback, w, memory)
        return state, f / self.gain - w


def _padded(coefficients: Row, size: int) -> Row:
    return (*coefficients, *(as_array(0.0),) * (size - len(coefficients)))
