"""Disturbance observer (DOB) with its Q-filter, around any controller."""

from typing import ClassVar, NamedTuple

import equinox as eqx

from ..core.arrays import Scalar, State, check_not_zero
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter, sample_time
from ..core.system import System
from ..dynamics.arma import ARMA
from .output_tracking import check_second_order

COEFFICIENTS = ("corrected", "printed")


class DisturbanceObserverState(NamedTuple):
    """State of the controller, the last estimate w, and the memory of the filter.

    ``memory`` holds the contributions of past samples to c_0 w one and two samples
    later, in V: the transposed direct form of (5.26), which has the fewest states.
    """

    feedback: State
    disturbance: Scalar
    memory: tuple[Scalar, Scalar]


class DisturbanceObserverControl(System):
    """``u = f / gain - w``: the controller's f less the estimated disturbance w.

    Figure 5.2, (5.26)-(5.32): w = Q/(gain G) z - Q u, where G is ``model``
    (a_1, a_2 | b_0, b_1, b_2, DC gain near 1), ``gain`` K_e is the linear part of the
    hysteresis, and Q has G's zeros, unit DC gain and a double pole at ``cutoff``. u is
    the applied voltage, after the limits. ``feedback`` sees the applied f,
    gain (u + w), in um.

    ``coefficients`` is ``"corrected"`` (the bilinear double pole) or ``"printed"``
    ((5.32) as printed, whose poles lie at -0.54 and -7.46 times the cut-off). Input an
    Observation, output in V.

    Raises ValueError for a model of another order or with DC gain 0, and for an unknown
    name in ``coefficients``.
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
        check_second_order(self.model)
        check_not_zero("DC gain of the model", sum(self.model.moving))
        if self.coefficients not in COEFFICIENTS:
            raise ValueError(
                f"coefficients {self.coefficients!r}; "
                f"it must be one of {list(COEFFICIENTS)}"
            )

    def denominator(self) -> tuple[Scalar, Scalar, Scalar]:
        """Return c_0, c_1, c_2 of the Q-filter (5.32)."""
        x = 1.0 / (self.cutoff * self.dt)
        square, double = (
            (x**2, 2.0 * x**2)
            if self.coefficients == "corrected"
            else (x**2 / 4.0, x**2 / 2.0)
        )
        total = sum(self.model.moving)
        return (
            (0.25 + square + x) * total,
            (0.5 - double) * total,
            (0.25 + square - x) * total,
        )

    def init(self, input: Observation) -> DisturbanceObserverState:
        # At rest Q = 1: w = z / (gain G(1)) - u.
        w = input.measured / (self.gain * self.model.dc_gain()) - input.applied
        force = self.gain * (input.applied + w)
        next_term, last_term = self._past(input, w)
        return DisturbanceObserverState(
            feedback=self.feedback.init(input._replace(applied=force)),
            disturbance=w,
            memory=(next_term + last_term, last_term),
        )

    def _past(self, input: Observation, w: Scalar) -> tuple[Scalar, Scalar]:
        """Return the contributions of a sample to c_0 w one and two samples later."""
        _, b1, b2 = self.model.moving
        a1, a2 = self.model.autoregressive
        _, c1, c2 = self.denominator()
        z, u = input.measured / self.gain, input.applied
        return -a1 * z - b1 * u - c1 * w, -a2 * z - b2 * u - c2 * w

    def step(
        self, state: DisturbanceObserverState, input: Observation
    ) -> tuple[DisturbanceObserverState, Scalar]:
        c0, _, _ = self.denominator()
        z, u = input.measured / self.gain, input.applied
        # Both filters of (5.26) have the denominator c, hence one recursion for both.
        w = (1.0 / c0) * (z - self.model.moving[0] * u + state.memory[0])
        next_term, last_term = self._past(input, w)
        memory = (next_term + state.memory[1], last_term)
        force = self.gain * (u + state.disturbance)
        feedback, f = self.feedback.step(state.feedback, input._replace(applied=force))
        state = DisturbanceObserverState(feedback, w, memory)
        return state, f / self.gain - w
