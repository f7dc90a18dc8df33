"""Differentiable sensitivity of a loop over frequency, from its impulse response.

The loop is linearised around an operating point, and a voltage impulse is added at the
plant's input. The voltage that then acts there is the impulse response of the
sensitivity S; with several axes an impulse on each axis gives a column of the matrix S.
This short run costs less than the run of one reference; solving for S at every
frequency costs more than the runs of all references. Use these figures in objectives,
constraints and sweeps; use ``stability_report``, which is exact, to assess one loop.

Error: S is sampled every 1 / ``duration`` in frequency, on one axis every 1 /
(``PADDING`` ``duration``). The peak of a resonance of quality factor Q at frequency f
is therefore too low by a relative error of at most (Q / (4 duration f))^2 / 2 on one
axis: 0.5 % for Q = 32 at 400 Hz. The response of a loop that rings for longer than
``duration`` is truncated: 1 - exp(-pi f duration / Q) of its peak is left.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ...core.arrays import Scalar, ScalarLike, State, as_array
from ...core.feedback import Feedback
from ...core.system import System
from ...dynamics.linearise import linearise, split_static
from ...engines import run_outputs
from .broken_loop import BrokenLoop, BrokenState, cut, open_loop
from .operating_point import BRANCHES, OperatingPoint

DURATION = 0.2
"""Length of the impulse response, s, if that is at least ``LEAST`` samples. Slower
modes are truncated."""

PADDING = 4
"""Number of lines per 1 / duration on one axis; on several axes it is 1, because each
line is a matrix."""

LEAST = 512
"""Least number of samples of the impulse response, for loops of a low rate."""

Sensitivity = Complex[Array, "*batch lines axes axes"]


class SmallMotion(System):
    """Closed loop linearised around an operating point, with transfer function S.

    S = 1/(1+L). Input: the voltage added at the plant's input, V. Output: the voltage
    that then acts there, V. States are those of ``broken`` as deviations from its
    operating point.
    """

    broken: BrokenLoop

    def init(self, input: Any = 0.0) -> State:
        """Return the operating point: zero deviations."""
        return jax.tree.map(jnp.zeros_like, split_static(self.broken.init())[0])

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        moving, held = split_static(self.broken.init())

        def step(moving: State, input: Any) -> tuple[State, Scalar]:
            state, output = self._moved(eqx.combine(moving, held), input)
            return split_static(state)[0], output

        input = jax.tree.map(as_array, input)
        still = jax.tree.map(jnp.zeros_like, input)
        return jax.jvp(step, (moving, still), (state, input))[1]

    def _moved(self, state: BrokenState, input: Any) -> tuple[BrokenState, Scalar]:
        return self.broken.closed(state, input)


class SmallFollowing(SmallMotion):
    """Closed loop linearised around an operating point, from reference to displacement.

    Input: the deviations of r(k) and r(k+1) from the reference of ``broken``, um.
    Output: the deviation of the displacement y(k) from the operating point, um.
    """

    def _moved(self, state: BrokenState, input: Any) -> tuple[BrokenState, Scalar]:
        unmoved = jnp.zeros_like(self.broken.start.voltage)
        return self.broken.closed(state, unmoved, input)[0], state.displacement


def sensitivity(
    loop: Feedback, at: Any = 0.0, duration: float | None = None
) -> Sensitivity:
    """Return S = (I+L)^-1 [lines, axes, axes] at equally spaced lines from 0 Hz on.

    One axis gives matrices of 1 x 1, at lines 1/(``PADDING`` T) apart; with several
    axes they are 1/T apart. T is ``duration`` (s), by default ``DURATION`` or
    ``LEAST`` samples, whichever is longer. L, ``at`` and the errors raised are those of
    ``open_loop``. Usable inside ``jax.jit`` and differentiable. The impulse response
    of an unstable loop grows, and S is large: it serves as a barrier with a slope and
    has no meaning as a figure.
    """
    point = OperatingPoint.at(at)
    return _responses(loop, point, jnp.asarray([point.side]), duration)[0]


def sensitivity_impulse(
    loop: Feedback, at: Any = 0.0, duration: float | None = None
) -> Float[Array, "samples axes axes"]:
    """Return the impulse response of S; the arguments are those of ``sensitivity``."""
    point = OperatingPoint.at(at)
    return _impulses(loop, point, jnp.asarray([point.side]), duration)[0]


def sensitivities(
    loop: Feedback, at: Any = 0.0, duration: float | None = None
) -> Sensitivity:
    """Return S [branches, lines, axes, axes]; all else is as in ``sensitivity``.

    The branch of ``at`` is ignored.
    """
    return _responses(loop, OperatingPoint.at(at), _sides(), duration)


def references_followed(
    loop: Feedback, at: Any = 0.0, duration: float | None = None
) -> Complex[Array, "branches lines"]:
    """Return y/r of a loop of one axis, at the lines of ``sensitivities``.

    It is the response of the displacement to a small impulse of the reference. The
    arguments and the errors raised are those of ``sensitivities``.
    """
    point = OperatingPoint.at(at)
    samples = _samples(point.sample_time(loop), duration)

    def one(side: ScalarLike) -> Float[Array, " samples"]:
        broken = cut(loop, point.signal, side, point.state)
        # The impulse enters as r(k+1) one sample before it enters as r(k).
        following = jnp.zeros(samples + 1).at[0].set(1.0)
        now = jnp.zeros(samples + 1).at[1].set(1.0)
        return _run(SmallFollowing(broken), (now, following))[1:]

    return jnp.fft.rfft(jax.vmap(one)(_sides()), PADDING * samples, axis=1)


def closed_loop_poles(loop: Feedback, at: Any = 0.0) -> Complex[Array, " order"]:
    """Return the poles of the closed loop in the z plane, unordered.

    They include one conserved pole at z = 1 for each hysteresis in the plant or in the
    controller; ``StabilityReport`` leaves these out. Differentiable where eigenvalues
    are simple, on the CPU only. Arguments and errors are those of ``open_loop``.
    """
    model = open_loop(loop, at)
    return jnp.linalg.eigvals(model.A - model.B @ model.C)


def lines(dt: float, duration: float | None = None) -> np.ndarray:
    """Return the frequencies (Hz) of S of one axis."""
    return np.fft.rfftfreq(PADDING * _samples(dt, duration), dt)


def _sides() -> Float[Array, " branches"]:
    return jnp.asarray([*BRANCHES.values()])


def default_duration(dt: float) -> float:
    """Return the default length of the impulse response, s."""
    return dt * max(round(DURATION / dt), LEAST)


def duration_of(time_constant: float, dt: float, settled: float, most: int) -> float:
    """Return the length (s) of an impulse response that ends with an oscillation.

    It is at least the default one, and at least ``settled`` times the ``time_constant``
    (s) of the oscillation unless that is more than ``most`` samples. Longer ones are
    the default times a power of two: few programs serve all.
    """
    default = default_duration(dt)
    longer = max(1.0, settled * time_constant / default)
    longer = default * 2.0 ** math.ceil(math.log2(longer))
    return max(default, min(longer, most * dt))


def _samples(dt: float, duration: float | None) -> int:
    return round((default_duration(dt) if duration is None else duration) / dt)


def _responses(
    loop: Feedback,
    point: OperatingPoint,
    sides: Float[Array, " branches"],
    duration: float | None,
) -> Sensitivity:
    impulses = _impulses(loop, point, sides, duration)
    padding = 1 if isinstance(point.signal, tuple) else PADDING
    return jnp.fft.rfft(impulses, padding * impulses.shape[1], axis=1)


def _impulses(
    loop: Feedback,
    point: OperatingPoint,
    sides: Float[Array, " branches"],
    duration: float | None,
) -> Float[Array, "branches samples axes axes"]:
    signal, dt = point.signal, point.sample_time(loop)
    samples = _samples(dt, duration)
    impulse = _axes_impulse if isinstance(signal, tuple) else _impulse

    def one(side: ScalarLike) -> Float[Array, "samples axes axes"]:
        broken = cut(loop, signal, side, point.state)
        return impulse(broken, samples, dt)

    return jax.vmap(one)(sides)


def _impulse(
    broken: BrokenLoop, samples: int, dt: float
) -> Float[Array, "samples 1 1"]:
    """Return the impulse response of S, from a run of ``SmallMotion``."""
    impulse = jnp.zeros(samples).at[0].set(1.0)
    return _run(SmallMotion(broken), impulse)[:, None, None]


def _run(motion: SmallMotion, inputs: Any) -> Float[Array, " samples"]:
    """Return the output of a small motion at each sample."""
    return run_outputs(motion, inputs, motion.init())


def _axes_impulse(
    broken: BrokenLoop, samples: int, dt: float
) -> Float[Array, "samples axes axes"]:
    """Return the impulse response of S, from the matrices of the closed loop.

    It is I at k = 0 and -C A^(k-1) B after it, A that of the closed loop. A run over
    time as on one axis would take ten times as long to compile.
    """
    model = linearise(broken, broken.start.voltage, broken.init(), dt)
    A, B, C = model.A - model.B @ model.C, model.B, model.C
    axes, later = B.shape[1], samples - 1
    # A^k B for k < size, and C A^k for the multiples of size: few products, little
    # memory.
    size = 1 << (math.isqrt(later) - 1).bit_length()
    states, outputs = B[None], C[None]
    power = A
    while len(states) < size:
        states, power = jnp.concatenate([states, power @ states]), power @ power
    while len(outputs) * size < later:
        outputs, power = jnp.concatenate([outputs, outputs @ power]), power @ power
    response = -jnp.einsum("jpn,inq->jipq", outputs, states)
    response = response.reshape(-1, axes, axes)[:later]
    return jnp.concatenate([jnp.eye(axes)[None], response])
