"""Differentiable margins of a loop, from its response to an impulse.

The loop is linearised around an operating point, a voltage impulse is added at the
plant's input, and the voltage that then acts there is the sensitivity S in time. One
short run costs less than one reference, where a solution for every frequency costs
more than all of them. Use these figures in objectives, constraints and sweeps;
``stability_report`` is the exact source, for a judgement of one loop.

Error: S is sampled every 1 / ``duration`` in frequency, so that the peak of a resonance
of quality Q at f lies too low by a share of (Q / (duration f))^2 / 2 at most: 0.5 % for
Q = 8 at 400 Hz. A loop that rings for longer than ``duration`` is seen truncated.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ...core.arrays import Scalar, ScalarLike, State, as_array
from ...core.rollout import simulate
from ...core.system import Feedback, LoopState, System
from ...dynamics.linearise import parted
from .broken_loop import BrokenLoop, cut, open_loop
from .operating_point import BRANCHES, OperatingPoint

DURATION = 0.2
"""Length of the impulse response, s: slower modes are seen truncated, and lines of the
spectrum lie 1 / DURATION apart."""

UNREACHED = 1e6
"""Delay margin (samples) of a loop that no delay makes unstable: large, and finite for
its logarithm."""

Sensitivity = Complex[Array, "*batch lines"]


class SmallMotion(System):
    """A closed loop around an operating point: voltage added at the plant's input to
    the voltage that then acts there, V. Its transfer function is S = 1/(1+L).

    States are those of ``broken`` as deviations from its operating point; ``push`` is
    how far one volt at the plant moves them in a sample.
    """

    broken: BrokenLoop
    push: State

    def init(self, input: Any = 0.0) -> State:
        """Return the operating point."""
        return jax.tree.map(jnp.zeros_like, self.push)

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        # L answers one sample later: what it returns is known before it is fed.
        moved, returned = _tangent(self.broken, state, jnp.zeros(()))
        voltage = as_array(input) - returned
        return jax.tree.map(lambda x, b: x + b * voltage, moved, self.push), voltage


def _tangent(broken: BrokenLoop, state: State, input: Scalar) -> tuple[State, Scalar]:
    moving, held = parted(broken.init())

    def step(moving: State, voltage: Scalar) -> tuple[State, Scalar]:
        state, output = broken.step(eqx.combine(moving, held), voltage)
        return parted(state)[0], output

    return jax.jvp(step, (moving, broken.start.voltage), (state, input))[1]


def sensitivity(
    loop: Feedback, at: Any = 0.0, duration: float = DURATION
) -> Sensitivity:
    """Return S = 1/(1+L) [lines] at 0, 1/``duration``, 2/``duration``, ... Hz.

    L as for ``broken_loop``, whose arguments and errors these are, for one axis;
    ``duration`` in s. Usable inside ``jax.jit`` and differentiable. The response of an
    unstable loop grows, and S is large: a barrier with a slope rather than a figure.
    """
    point = OperatingPoint.at(at)
    reference, dt = as_array(point.reference), point.sample_time(loop)
    return _sensitivity(loop, reference, point.side, point.state, dt, duration)


def sensitivities(
    loop: Feedback, at: Any = 0.0, duration: float = DURATION
) -> Sensitivity:
    """Return S on every branch, [branches, lines]; otherwise as ``sensitivity``.

    The branch that ``at`` names does not matter.
    """
    point = OperatingPoint.at(at)
    reference, dt = as_array(point.reference), point.sample_time(loop)
    return jax.vmap(
        lambda side: _sensitivity(loop, reference, side, point.state, dt, duration)
    )(jnp.asarray(list(BRANCHES.values())))


def sensitivity_peak(
    loop: Feedback, at: Any = 0.0, duration: float = DURATION
) -> Float[Array, ""]:
    """Return Ms = max |S| of a loop of one axis; arguments as for ``sensitivity``."""
    return peak_of(sensitivity(loop, at, duration))


def closed_loop_poles(loop: Feedback, at: Any = 0.0) -> Complex[Array, " order"]:
    """Return the eigenvalues of the closed loop in the z plane, in no order.

    The poles at z = 1 of the memory of a hysteresis are among them, one for each
    hysteresis in the plant or in the controller; ``StabilityReport`` leaves them out.
    Differentiable where eigenvalues are simple, on the CPU. Arguments and errors as for
    ``open_loop``.
    """
    model = open_loop(loop, at)
    return jnp.linalg.eigvals(model.A - model.B @ model.C)


def _sensitivity(
    loop: Feedback,
    reference: Scalar,
    side: ScalarLike,
    state: LoopState | None,
    dt: float,
    duration: float,
) -> Sensitivity:
    broken = cut(loop, reference, side, state)
    rest = jax.tree.map(jnp.zeros_like, parted(broken.init())[0])
    push, _ = _tangent(broken, rest, jnp.ones(()))
    impulse = jnp.zeros(round(duration / dt)).at[0].set(1.0)
    _, response = simulate(SmallMotion(broken, push), impulse)
    return jnp.fft.rfft(response)


def peak_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return Ms = max |S|."""
    return jnp.max(jnp.abs(sensitivity))


def disk_margin_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return alpha = 1 / max |(S - T)/2|, as in ``StabilityReport``."""
    return 1.0 / jnp.max(jnp.abs(sensitivity - 0.5))


def delay_margin_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return the delay margin in samples, ``UNREACHED`` where |L| crosses 1 nowhere.

    Crossings lie between two lines of the spectrum and are interpolated.
    """
    loop = 1.0 / sensitivity[1:] - 1.0
    angle = jnp.linspace(0.0, jnp.pi, sensitivity.size)[1:]
    gain = jnp.log(jnp.abs(loop))
    lag = jnp.mod(jnp.angle(loop) + jnp.pi, 2.0 * jnp.pi)
    crosses = gain[:-1] * gain[1:] < 0.0
    share = gain[:-1] / jnp.where(crosses, gain[:-1] - gain[1:], 1.0)
    # The short way round between two lines.
    turn = jnp.mod(lag[1:] - lag[:-1] + jnp.pi, 2.0 * jnp.pi) - jnp.pi
    there = jnp.mod(lag[:-1] + share * turn, 2.0 * jnp.pi)
    place = angle[:-1] + share * (angle[1:] - angle[:-1])
    return jnp.min(jnp.where(crosses, there / place, UNREACHED))
