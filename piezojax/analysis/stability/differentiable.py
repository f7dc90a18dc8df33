"""Differentiable margins of a loop, from its impulse response.

The loop is linearised around an operating point, and a voltage impulse is added at the
plant's input. The voltage that then acts there is the impulse response of the
sensitivity S. This short run costs less than the run of one reference; solving for S at
every frequency costs more than the runs of all references. Use these figures in
objectives, constraints and sweeps; use ``stability_report``, which is exact, to assess
one loop.

Error: S is sampled every 1 / ``duration`` in frequency. The peak of a resonance of
quality factor Q at frequency f is therefore too low by a relative error of at most
(Q / (duration f))^2 / 2: 0.5 % for Q = 8 at 400 Hz. The response of a loop that rings
for longer than ``duration`` is truncated.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ...core.arrays import Scalar, ScalarLike, State, as_array
from ...core.feedback import Feedback, LoopState
from ...core.rollout import simulate
from ...core.system import System
from ...dynamics.linearise import split_static
from .broken_loop import BrokenLoop, cut, open_loop
from .operating_point import BRANCHES, OperatingPoint

DURATION = 0.2
"""Length of the impulse response, s. Slower modes are truncated, and lines of the
spectrum lie 1 / DURATION apart."""

UNREACHED = 1e6
"""Delay margin (samples) of a loop that no delay makes unstable: large, but finite so
that its logarithm is."""

Sensitivity = Complex[Array, "*batch lines"]


class SmallMotion(System):
    """Closed loop linearised around an operating point, with transfer function S.

    S = 1/(1+L). Input: the voltage added at the plant's input, V. Output: the voltage
    that then acts there, V. States are those of ``broken`` as deviations from its
    operating point; ``push`` is their change in one sample for 1 V at the plant.
    """

    broken: BrokenLoop
    push: State

    def init(self, input: Any = 0.0) -> State:
        """Return the operating point: zero deviations."""
        return jax.tree.map(jnp.zeros_like, self.push)

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        # L answers one sample later: its output is known before its input.
        moved, returned = _tangent(self.broken, state, jnp.zeros(()))
        voltage = as_array(input) - returned
        return jax.tree.map(lambda x, b: x + b * voltage, moved, self.push), voltage


def _tangent(broken: BrokenLoop, state: State, input: Scalar) -> tuple[State, Scalar]:
    moving, held = split_static(broken.init())

    def step(moving: State, voltage: Scalar) -> tuple[State, Scalar]:
        state, output = broken.step(eqx.combine(moving, held), voltage)
        return split_static(state)[0], output

    return jax.jvp(step, (moving, broken.start.voltage), (state, input))[1]


def sensitivity(
    loop: Feedback, at: Any = 0.0, duration: float = DURATION
) -> Sensitivity:
    """Return S = 1/(1+L) [lines] at 0, 1/``duration``, 2/``duration``, ... Hz.

    The loop has one axis. L, ``at`` and the errors raised are those of ``broken_loop``;
    ``duration`` in s. Usable inside ``jax.jit`` and differentiable. The impulse
    response of an unstable loop grows, and S is large: it serves as a barrier with a
    slope and has no meaning as a figure.
    """
    point = OperatingPoint.at(at)
    reference, dt = as_array(point.reference), point.sample_time(loop)
    return _sensitivity(loop, reference, point.side, point.state, dt, duration)


def sensitivities(
    loop: Feedback, at: Any = 0.0, duration: float = DURATION
) -> Sensitivity:
    """Return S [branches, lines] on every branch; otherwise as ``sensitivity``.

    The branch of ``at`` is ignored.
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
    """Return the poles of the closed loop in the z plane, unordered.

    They include one conserved pole at z = 1 for each hysteresis in the plant or in the
    controller; ``StabilityReport`` leaves these out. Differentiable where eigenvalues
    are simple, on the CPU only. Arguments and errors are those of ``open_loop``.
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
    rest = jax.tree.map(jnp.zeros_like, split_static(broken.init())[0])
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
    """Return the delay margin in samples, ``UNREACHED`` if |L| never crosses 1.

    Crossings are interpolated between two lines of the spectrum.
    """
    loop = 1.0 / sensitivity[1:] - 1.0
    angle = jnp.linspace(0.0, jnp.pi, sensitivity.size)[1:]
    gain = jnp.log(jnp.abs(loop))
    lag = jnp.mod(jnp.angle(loop) + jnp.pi, 2.0 * jnp.pi)
    crosses = gain[:-1] * gain[1:] < 0.0
    share = gain[:-1] / jnp.where(crosses, gain[:-1] - gain[1:], 1.0)
    # Phase difference of two lines, wrapped to [-pi, pi).
    turn = jnp.mod(lag[1:] - lag[:-1] + jnp.pi, 2.0 * jnp.pi) - jnp.pi
    there = jnp.mod(lag[:-1] + share * turn, 2.0 * jnp.pi)
    place = angle[:-1] + share * (angle[1:] - angle[:-1])
    return jnp.min(jnp.where(crosses, there / place, UNREACHED))
