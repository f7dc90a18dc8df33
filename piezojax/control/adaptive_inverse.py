"""Adaptive inverse feedforward: an inverse of the stage learned in the loop."""

from typing import NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, State, as_array, as_scalars
from ..core.feedback import Observation
from ..core.parameter import parameter, sample_time
from ..core.system import Series, System
from ..dynamics.lag import FirstOrderLag
from .recursive_weights import RecursiveWeights

Row = tuple[Scalar, ...]


class TermsState(NamedTuple):
    """Last two positions, last input of the stops, and their outputs, all in um."""

    positions: tuple[Scalar, Scalar]
    leading: Scalar
    stops: Row


class MotionTerms(System):
    """Regressors of the voltage for a motion y: y, dy/dt, d2y/dt2 and stops.

    Input um; output um, um/s, um/s^2, and um for each of ``thresholds`` (um). A stop
    operator follows its input and saturates at its threshold. It is the dual of the
    play operator: the inverse of a Prandtl-Ishlinskii model is a weighted sum of the
    output of the model and of stops of this output. The output of a hysteresis ahead of
    slow dynamics leads y, so the stops follow ``y + lead dy/dt``.
    """

    thresholds: Row = parameter(
        "um", "thresholds of the stop operators", above=0.0, converter=as_scalars
    )
    lead: Scalar = parameter("s", "lead of the input of the stops", least=0.0)
    dt: float = sample_time()

    def init(self, input: ScalarLike = 0.0) -> TermsState:
        position = as_array(input)
        at_rest = (jnp.zeros_like(position),) * len(self.thresholds)
        return TermsState((position, position), position, at_rest)

    def step(self, state: TermsState, input: ScalarLike) -> tuple[TermsState, Row]:
        position = as_array(input)
        last, older = state.positions
        velocity = (position - last) / self.dt
        acceleration = (position - 2.0 * last + older) / self.dt**2
        leading = position + self.lead * velocity
        moved = leading - state.leading
        stops = tuple(
            jnp.clip(stop + moved, -threshold, threshold)
            for stop, threshold in zip(state.stops, self.thresholds, strict=True)
        )
        state = TermsState((position, last), leading, stops)
        return state, (position, velocity, acceleration, *stops)


class AdaptiveInverseState(NamedTuple):
    """States of the controller, the weights, the filters and the motion terms.

    ``feedforward`` is the last feedforward voltage in V, ``motion`` the terms of the
    reference from which it was computed.
    """

    controller: State
    weights: State
    filters: tuple[State, State]
    measured: TermsState
    reference: TermsState
    motion: Row
    feedforward: Scalar


class AdaptiveInverse(System):
    """``u = share * (learned inverse of the reference) + controller(residual)``.

    The voltage of a stage is modelled as a weighted sum of its MotionTerms: position,
    velocity, acceleration and stop operators. Such a sum is the inverse of a gain, two
    poles and a hysteresis ahead of them, if ``lead`` is about the sum of the time
    constants of the poles. RecursiveWeights learns the weights from the applied voltage
    and the terms of the measured displacement, both filtered by the same double lag at
    ``cutoff``. The weighted sum of the reference's terms is fed forward. Gain, poles
    and hysteresis need not be known, and the feedback corrects the remaining error.
    Sources: adaptive inverse control, Widrow and Walach 1996; stop operators for the
    inverse of a hysteresis, Kuhnen and Krejci 2007.

    ``controller`` receives the reference and the measurement, both less ``share`` times
    the reference, and the applied voltage less the voltage fed forward. With a
    ``share`` of 0 it acts alone. Only changes of the motion are fed forward, so a
    learned weight does not change the voltage at rest, and the stability margins at
    rest are those of ``controller``. While the stage moves, learning forms a second,
    slow loop that these margins do not include.

    ``weights`` are in V/um, V s/um and V s^2/um, then V/um for each stop. An offset of
    the voltage is learned with them, from its value at the start, but not fed forward.
    Input an Observation, output V, one axis.

    Raises ValueError for a parameter outside its limits or counts that do not match.
    """

    controller: System
    weights: Row = parameter("V per term", "weights at the start", converter=as_scalars)
    deviations: Row = parameter(
        "V per term",
        "standard deviations of the weights at the start",
        least=0.0,
        converter=as_scalars,
    )
    thresholds: Row = parameter(
        "um", "thresholds of the stop operators", above=0.0, converter=as_scalars
    )
    cutoff: Scalar = parameter(
        "rad/s",
        "cut-off frequency of the filters",
        above=0.0,
        below_nyquist=True,
        scale="log",
        typical=(1e2, 1e4),
    )
    equation_error: Scalar = parameter(
        "V",
        "standard deviation of the residual of the voltage model",
        above=0.0,
        scale="log",
        typical=(1e-2, 1e2),
    )
    memory: Scalar = parameter(
        "s",
        "time constant of forgetting",
        above=0.0,
        scale="log",
        typical=(1e-2, 1e2),
    )
    dt: float = sample_time()
    lead: Scalar = parameter(
        "s",
        "lead of the input of the stops",
        least=0.0,
        typical=(0.0, 5e-3),
        default=0.0,
    )
    share: Scalar = parameter(
        "1",
        "share of the reference that is fed forward",
        typical=(0.0, 1.0),
        default=1.0,
    )
    offset_deviation: Scalar = parameter(
        "V",
        "standard deviation of the voltage offset",
        above=0.0,
        scale="log",
        default=10.0,
    )

    def __check_init__(self):
        if len(self.deviations) != len(self.weights):
            raise ValueError(
                f"{len(self.weights)} weights and {len(self.deviations)} deviations; "
                "each weight needs one"
            )
        if len(self.weights) != 3 + len(self.thresholds):
            raise ValueError(
                f"{len(self.weights)} weights for {len(self.thresholds)} thresholds; "
                "there must be three weights and one more for each threshold"
            )

    def _learning(self, offset: Scalar) -> RecursiveWeights:
        return RecursiveWeights(
            (offset, *self.weights),
            (self.offset_deviation, *self.deviations),
            self.equation_error,
            self.memory,
            self.dt,
        )

    def _motion(self) -> MotionTerms:
        return MotionTerms(self.thresholds, self.lead, self.dt)

    def _filter(self) -> Series:
        lag = FirstOrderLag(1.0 / self.cutoff, self.dt)
        return lag >> lag

    def _residual(self, input: Observation, feedforward: Scalar) -> Observation:
        """Return the Observation of the controller: ``input`` less the feedforward."""
        fed = self.share * input.reference
        return Observation(
            reference=input.reference - fed,
            next_reference=(1.0 - self.share) * input.next_reference,
            measured=input.measured - fed,
            applied=input.applied - self.share * feedforward,
        )

    def init(self, input: Observation) -> AdaptiveInverseState:
        voltage = as_array(input.applied)
        motion, low_pass = self._motion(), self._filter()
        measured, reference = motion.init(input.measured), motion.init(input.reference)
        _, reference_terms = motion.step(reference, input.reference)
        offset = voltage - self.weights[0] * input.measured
        return AdaptiveInverseState(
            controller=self.controller.init(self._residual(input, voltage)),
            weights=self._learning(offset).init(),
            filters=(low_pass.init(voltage), low_pass.init(as_array(input.measured))),
            measured=measured,
            reference=reference,
            motion=reference_terms,
            feedforward=voltage,
        )

    def step(
        self, state: AdaptiveInverseState, input: Observation
    ) -> tuple[AdaptiveInverseState, Scalar]:
        motion, low_pass = self._motion(), self._filter()
        # u(k-1) moved the stage to z(k), as u(k) moves it to r(k+1) below.
        of_voltage, voltage = low_pass.step(state.filters[0], input.applied)
        of_position, position = low_pass.step(state.filters[1], input.measured)
        measured, row = motion.step(state.measured, position)
        learned, (_, *weights) = self._learning(as_array(0.0)).step(
            state.weights, ((jnp.ones(()), *row), voltage)
        )
        controller, correction = self.controller.step(
            state.controller, self._residual(input, state.feedforward)
        )
        reference, reference_terms = motion.step(state.reference, input.next_reference)
        feedforward = state.feedforward + sum(
            weight * (new - old)
            for weight, new, old in zip(
                weights, reference_terms, state.motion, strict=True
            )
        )
        state = AdaptiveInverseState(
            controller,
            learned,
            (of_voltage, of_position),
            measured,
            reference,
            reference_terms,
            feedforward,
        )
        return state, correction + self.share * feedforward
