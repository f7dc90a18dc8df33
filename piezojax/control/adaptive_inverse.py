"""An inverse of the stage, learned while the loop runs and fed forward."""

from typing import NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, State, as_array, as_scalars
from ..core.parameter import parameter, sample_time
from ..core.system import Observation, Series, System
from ..dynamics.lag import FirstOrderLag
from .recursive_weights import RecursiveWeights

Row = tuple[Scalar, ...]


class TermsState(NamedTuple):
    """The last two positions (um) and the stop operators (um)."""

    positions: tuple[Scalar, Scalar]
    stops: Row


class MotionTerms(System):
    """Terms of the voltage that holds a position: y, dy/dt, d2y/dt2 and stops of y.

    Input um; output um, um/s, um/s^2, and um for each of ``thresholds`` (um). A stop
    operator follows the position and saturates at its threshold: the dual of the play
    of a Prandtl-Ishlinskii model, whose inverse is a sum of both.
    """

    thresholds: Row = parameter(
        "um", "thresholds of the stop operators", above=0.0, converter=as_scalars
    )
    dt: float = sample_time()

    def init(self, input: ScalarLike = 0.0) -> TermsState:
        position = as_array(input)
        at_rest = (jnp.zeros_like(position),) * len(self.thresholds)
        return TermsState((position, position), at_rest)

    def step(self, state: TermsState, input: ScalarLike) -> tuple[TermsState, Row]:
        position = as_array(input)
        last, older = state.positions
        moved = position - last
        stops = tuple(
            jnp.clip(stop + moved, -threshold, threshold)
            for stop, threshold in zip(state.stops, self.thresholds, strict=True)
        )
        velocity = moved / self.dt
        acceleration = (moved - (last - older)) / self.dt**2
        state = TermsState((position, last), stops)
        return state, (position, velocity, acceleration, *stops)


class AdaptiveInverseState(NamedTuple):
    """Controller, learned weights, both motions with their filters, and what was fed
    forward: the voltage (V) and the motion that it belongs to."""

    controller: State
    weights: State
    measured: TermsState
    filtered: tuple[State, ...]
    reference: TermsState
    motion: Row
    feedforward: Scalar


class AdaptiveInverse(System):
    """``u = share * (learned inverse of the reference) + controller(the rest)``.

    The voltage of a stage is taken as a weighted sum of its MotionTerms: position,
    velocity, acceleration and stop operators, the inverse of gain, two poles and
    hysteresis. The weights are learned from what was applied and measured, both through
    the same double lag at ``cutoff``, by RecursiveWeights, and the weighted sum of the
    reference's own terms is fed forward. So gain, poles and hysteresis need not be
    known, and the feedback is left with what no model says. Sources: adaptive inverse
    control, Widrow and Walach 1996; stop operators for the inverse of a hysteresis,
    Kuhnen and Krejci 2007.

    With a ``share`` of 0 only ``controller`` acts. It sees the rest of the reference,
    and measurement and voltage without the part that was fed forward. Only changes of
    the motion are fed forward, so a learned weight moves nothing at rest, and the
    margins there are those of ``controller``. While the stage moves, learning is a slow
    loop of its own that the margins do not show.

    ``weights`` are in V/um, V s/um and V s^2/um, then V/um for each stop. The start
    settles the voltage at zero. Input an Observation, output V, one axis.

    Raises ValueError for counts that do not match.
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
        "standard deviation of the rest of the relation",
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
    share: Scalar = parameter(
        "1",
        "share of the reference that the inverse carries",
        typical=(0.0, 1.0),
        default=1.0,
    )
    offset_deviation: Scalar = parameter(
        "V",
        "standard deviation of the voltage at zero",
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
                "it must be three and one for each"
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
        return MotionTerms(self.thresholds, self.dt)

    def _filter(self) -> Series:
        lag = FirstOrderLag(1.0 / self.cutoff, self.dt)
        return lag >> lag

    def _rest(self, input: Observation, feedforward: Scalar) -> Observation:
        """Return what is left for the controller."""
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
        _, seen = motion.step(measured, input.measured)
        _, wanted = motion.step(reference, input.reference)
        offset = voltage - self.weights[0] * input.measured
        return AdaptiveInverseState(
            controller=self.controller.init(self._rest(input, voltage)),
            weights=self._learning(offset).init(),
            measured=measured,
            filtered=tuple(low_pass.init(signal) for signal in (voltage, *seen)),
            reference=reference,
            motion=wanted,
            feedforward=voltage,
        )

    def step(
        self, state: AdaptiveInverseState, input: Observation
    ) -> tuple[AdaptiveInverseState, Scalar]:
        motion, low_pass = self._motion(), self._filter()
        # u(k-1) and z(k) belong together, as u(k) and r(k+1) do below.
        measured, seen = motion.step(state.measured, input.measured)
        passed = [
            low_pass.step(memory, signal)
            for memory, signal in zip(
                state.filtered, (input.applied, *seen), strict=True
            )
        ]
        voltage, *row = (signal for _, signal in passed)
        learned, (_, *weights) = self._learning(as_array(0.0)).step(
            state.weights, ((jnp.ones(()), *row), voltage)
        )
        controller, left = self.controller.step(
            state.controller, self._rest(input, state.feedforward)
        )
        reference, wanted = motion.step(state.reference, input.next_reference)
        feedforward = state.feedforward + sum(
            weight * (new - old)
            for weight, new, old in zip(weights, wanted, state.motion, strict=True)
        )
        state = AdaptiveInverseState(
            controller,
            learned,
            measured,
            tuple(memory for memory, _ in passed),
            reference,
            wanted,
            feedforward,
        )
        return state, left + self.share * feedforward
