"""Margins of a loop from its response to an impulse: cheap, and differentiable.

The loop is taken for small motions around an operating point, a voltage impulse is
added at the plant's input, and the voltage that then acts there is its sensitivity S in
time. One short run costs less than one reference, where solving for every frequency
costs more than all of them; ``stability_report`` is exact and says the same.
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
from .broken_loop import BRANCHES, BrokenLoop, cut, loop_sample_time, side_of

DURATION = 0.2
"""Length of the impulse response, s: what is slower than that rings on unseen, and
lines of the spectrum lie 1 / DURATION apart."""

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
    loop: Feedback,
    reference: ScalarLike = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
    duration: float = DURATION,
) -> Sensitivity:
    """Return S = 1/(1+L) at 0, 1/``duration``, 2/``duration``, ... Hz.

    L as for ``broken_loop``, whose arguments and errors these are, for one axis. Usable
    inside ``jax.jit`` and differentiable. Of an unstable loop the response grows, and
    what is returned is large: with its slope, a barrier rather than a figure.
    """
    dt = loop_sample_time(loop) if dt is None else dt
    return _sensitivity(loop, as_array(reference), side_of(branch), state, dt, duration)


def sensitivities(
    loop: Feedback,
    reference: Any = 0.0,
    dt: float | None = None,
    duration: float = DURATION,
) -> Sensitivity:
    """Return S on every branch, [branches, lines]; otherwise as ``sensitivity``."""
    dt = loop_sample_time(loop) if dt is None else dt
    return jax.vmap(
        lambda side: _sensitivity(loop, as_array(reference), side, None, dt, duration)
    )(jnp.asarray(list(BRANCHES.values())))


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
