"""Switching laws of sliding mode control, which act on the sliding variable s."""

import abc
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, Signal, State, as_array
from ..core.axes import Matrix, as_matrix, check_square, product
from ..core.parameter import declarations, parameter, sample_time
from ..core.system import System
from .anti_windup import anti_windup

Gain: TypeAlias = Scalar | Matrix
"""A gain of one axis or for all axes, or a matrix of gains."""


def as_gain(value: Any) -> Any:
    """Return a number as a scalar, and a matrix or its diagonal as a Matrix."""
    if isinstance(value, tuple | list) or jnp.ndim(value) == 2:
        return as_matrix(value)
    return as_array(value)


class SwitchingLaw(System):
    """A System from the sliding variable s to the switching part of a control.

    [s] is the unit of s and [v] that of the output; the controller declares both.
    """

    @abc.abstractmethod
    def start(self, sliding: Signal, output: Signal) -> State:
        """Return the state in which the law gives ``output`` at a constant ``sliding``.

        A law without an integral adds a constant bias to its output, so that every
        start at rest is bumpless.
        """

    @abc.abstractmethod
    def driven(self, state: State, shortfall: Signal) -> State:
        """Return ``state`` with its integral driven by ``shortfall`` (anti-windup).

        ``shortfall`` in [v] is the output that the actuator applied less the one that
        the law gave. A law without an integral returns its state.
        """

    def init(self, input: Signal = 0.0) -> State:
        return self.start(input, jax.tree.map(jnp.zeros_like, input))


def check_gains(law: SwitchingLaw, axes: int) -> None:
    """Raise ValueError unless every matrix in ``law`` has ``axes`` rows and columns."""
    for name, _ in declarations(law):
        gain = getattr(law, name)
        if isinstance(gain, tuple):
            check_square(f"law.{name}", gain, axes)


class SwitchingPIDState(NamedTuple):
    """Integral part in [v] and the last s in [s]."""

    integral: Signal
    sliding: Signal


class SwitchingPID(SwitchingLaw):
    """PID as switching part: ``v = -(P s + I int s dt + D ds/dt)``.

    The law of (4.43), (5.18), (7.33) and (8.34). With several axes s and v are tuples
    of one scalar per axis, and a gain is a scalar for all axes, one number per axis, or
    a matrix.
    ``anti_windup`` drives the integral by the difference of the applied and the last
    commanded v (back-calculation), for each axis separately; the thesis has none.
    """

    proportional: Gain = parameter(
        "[v]/[s]",
        "proportional gain of the sliding variable",
        scale="log",
        typical=(1e-7, 1e2),
        converter=as_gain,
    )
    integral: Gain = parameter(
        "[v]/([s] s)",
        "integral gain of the sliding variable",
        scale="log",
        typical=(1e-1, 1e4),
        converter=as_gain,
    )
    derivative: Gain = parameter(
        "[v] s/[s]",
        "derivative gain of the sliding variable",
        scale="log",
        typical=(1e-9, 1e-2),
        converter=as_gain,
    )
    dt: float = sample_time()
    anti_windup: Scalar = anti_windup()

    def start(self, sliding: Signal, output: Signal) -> SwitchingPIDState:
        sliding = jax.tree.map(as_array, sliding)
        integral = jax.tree.map(jnp.add, output, _times(self.proportional, sliding))
        return SwitchingPIDState(integral, sliding)

    def driven(self, state: SwitchingPIDState, shortfall: Signal) -> SwitchingPIDState:
        share = self.anti_windup * self.dt
        return state._replace(
            integral=jax.tree.map(lambda i, v: i + share * v, state.integral, shortfall)
        )

    def step(
        self, state: SwitchingPIDState, input: Signal
    ) -> tuple[SwitchingPIDState, Signal]:
        # Gain times dt is loop-invariant.
        rate = jax.tree.map(lambda gain: gain * self.dt, self.integral)
        integral = jax.tree.map(jnp.subtract, state.integral, _times(rate, input))
        change = jax.tree.map(jnp.subtract, input, state.sliding)
        output = jax.tree.map(
            lambda i, p, d: i - p - d / self.dt,
            integral,
            _times(self.proportional, input),
            _times(self.derivative, change),
        )
        return SwitchingPIDState(integral, input), output


def _times(gain: Gain, signal: Signal) -> Any:
    if isinstance(gain, tuple):
        return product(gain, signal)
    return jax.tree.map(lambda value: gain * value, signal)


class BangBang(SwitchingLaw):
    """Bang-bang switching, ``v = -gain sign(s)``, which chatters.

    The law of the nominal sliding mode control of section 4.5.4.1, the baseline of the
    others. Without an integral an offset remains. The derivative of sign is taken as
    zero.
    """

    gain: Scalar = parameter(
        "[v]", "switching gain K", least=0.0, scale="log", typical=(1e-2, 1e5)
    )

    def start(self, sliding: ScalarLike, output: ScalarLike) -> Scalar:
        return as_array(output) + self.gain * jnp.sign(as_array(sliding))

    def driven(self, state: Scalar, shortfall: ScalarLike) -> Scalar:
        return state

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        return state, state - self.gain * jnp.sign(as_array(input))


class BoundaryLayer(SwitchingLaw):
    """Boundary layer, ``v = -gain sat(s / width)``: proportional within ``width``.

    The law of section 2.6.1.2, reference [94] there. A width near zero gives
    bang-bang switching. Without an integral an offset remains, which is smaller for a
    larger gain / width. The derivative is -gain / width inside, zero outside and
    between the two on the edge.
    """

    gain: Scalar = parameter(
        "[v]", "switching gain K", least=0.0, scale="log", typical=(1e-2, 1e5)
    )
    width: Scalar = parameter(
        "[s]", "width of the boundary layer", above=0.0, scale="log", typical=(1.0, 1e5)
    )

    def start(self, sliding: ScalarLike, output: ScalarLike) -> Scalar:
        return as_array(output) - self._switched(sliding)

    def driven(self, state: Scalar, shortfall: ScalarLike) -> Scalar:
        return state

    def _switched(self, sliding: ScalarLike) -> Scalar:
        return -self.gain * jnp.clip(sliding / self.width, -1.0, 1.0)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        return state, state + self._switched(input)


class SuperTwisting(SwitchingLaw):
    """Smoothed super-twisting: ``v = w - root_gain |s|^(1/2) sign(s)``.

    Its state is w with ``dw/dt = -sign_gain sign(s)``. This second-order sliding mode
    needs only s (A. Levant, Int. J. Control 58, 1993; section 2.6.1.2). In discrete
    time the sign chatters by ``sign_gain dt`` about s = 0, and the derivative of the
    root is infinite there. Both are therefore smoothed over ``layer`` d:
    s / (s^2 + d^2)^(1/4) and s / (s^2 + d^2)^(1/2) equal the root and the sign far
    outside the layer, and form a proportional-integral law of s inside. The law rests
    at s = 0 with any w.
    """

    root_gain: Scalar = parameter(
        "[v]/[s]^(1/2)", "gain of the root", least=0.0, scale="log", typical=(1e-2, 1e3)
    )
    sign_gain: Scalar = parameter(
        "[v]/s", "gain of the sign", least=0.0, scale="log", typical=(1.0, 1e8)
    )
    layer: Scalar = parameter(
        "[s]", "width of the smooth layer", above=0.0, scale="log", typical=(1.0, 1e5)
    )
    dt: float = sample_time()
    anti_windup: Scalar = anti_windup()

    def start(self, sliding: ScalarLike, output: ScalarLike) -> Scalar:
        return as_array(output) + self._root(as_array(sliding))

    def driven(self, state: Scalar, shortfall: ScalarLike) -> Scalar:
        return state + self.anti_windup * self.dt * shortfall

    def _root(self, sliding: Scalar) -> Scalar:
        return self.root_gain * sliding / jnp.sqrt(self._distance(sliding))

    def _distance(self, sliding: Scalar) -> Scalar:
        return jnp.sqrt(sliding**2 + self.layer**2)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        sliding = as_array(input)
        rate = self.sign_gain * self.dt * sliding / self._distance(sliding)
        return state - rate, state - rate - self._root(sliding)
