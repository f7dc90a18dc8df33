"""Differentiable margins of a loop, from its impulse response.

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
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ...core.arrays import Scalar, ScalarLike, State, as_array, largest, smallest
from ...core.feedback import Feedback
from ...core.system import System
from ...dynamics.linearise import linearise, split_static
from ...engines import metered
from .broken_loop import BrokenLoop, BrokenState, cut, open_loop
from .operating_point import BRANCHES, OperatingPoint

DURATION = 0.2
"""Length of the impulse response, s, if that is at least ``LEAST`` samples. Slower
modes are truncated."""

PADDING = 4
"""Number of lines per 1 / duration on one axis; on several axes it is 1, because each
line is a matrix."""

UNLIMITED_DELAY = 1e6
"""Delay margin (samples) of a loop that no delay makes unstable: large, but with a
finite logarithm."""

UNLIMITED_GAIN = 120.0
"""Gain margin (dB) of a loop that no gain makes unstable."""

NO_MARGIN = 1e3
"""Peak of |S| above which gain, phase and delay margin are 0. A stable loop has less
than 0.1 degrees left, and crossings of an unstable one say nothing."""

BAND = math.log(10.0) * -3.0 / 20.0
"""Logarithm of |y/r| at the end of the band of a loop: -3 dB."""

LEAST = 512
"""Least number of samples of the impulse response, for loops of a low rate."""

BANDS = 10
"""Number of bands of ``peaks_of``: octaves down from the Nyquist frequency, and one
band below them."""

Sensitivity = Complex[Array, "*batch lines axes axes"]

_WHOLE = (slice(0, None),)

_SQUARINGS = 24
"""Number of squarings of a Gram matrix that give its largest eigenvalue, with a
relative error of at most ln(axes) / 2^24."""


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
    loop: Feedback, at: Any = 0.0
) -> Complex[Array, "branches lines"]:
    """Return y/r of a loop of one axis, at the lines of ``sensitivities``.

    It is the response of the displacement to a small impulse of the reference. ``at``
    and the errors raised are those of ``sensitivities``.
    """
    point = OperatingPoint.at(at)
    samples = _samples(point.sample_time(loop))

    def one(side: ScalarLike) -> Float[Array, " samples"]:
        broken = cut(loop, point.signal, side, point.state)
        # The impulse enters as r(k+1) one sample before it enters as r(k).
        following = jnp.zeros(samples + 1).at[0].set(1.0)
        now = jnp.zeros(samples + 1).at[1].set(1.0)
        return _run(SmallFollowing(broken), (now, following))[1:]

    return jnp.fft.rfft(jax.vmap(one)(_sides()), PADDING * samples, axis=1)


def sensitivity_peak(
    loop: Feedback, at: Any = 0.0, duration: float | None = None
) -> Float[Array, ""]:
    """Return Ms as ``peak_of`` does; the arguments are those of ``sensitivity``."""
    return peak_of(sensitivity(loop, at, duration))


def closed_loop_poles(loop: Feedback, at: Any = 0.0) -> Complex[Array, " order"]:
    """Return the poles of the closed loop in the z plane, unordered.

    They include one conserved pole at z = 1 for each hysteresis in the plant or in the
    controller; ``StabilityReport`` leaves these out. Differentiable where eigenvalues
    are simple, on the CPU only. Arguments and errors are those of ``open_loop``.
    """
    model = open_loop(loop, at)
    return jnp.linalg.eigvals(model.A - model.B @ model.C)


def lines(dt: float) -> np.ndarray:
    """Return the frequencies (Hz) of S of one axis for the default duration."""
    return np.fft.rfftfreq(PADDING * _samples(dt), dt)


def _sides() -> Float[Array, " branches"]:
    return jnp.asarray([*BRANCHES.values()])


def _samples(dt: float) -> int:
    return max(round(DURATION / dt), LEAST)


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
    samples = round(_samples(dt) if duration is None else duration / dt)
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
    return metered(motion, inputs, motion.init(), log=lambda output: output)[1]


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


@jax.jit
def peak_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return Ms, the largest singular value of S over frequency; |S| on one axis.

    On several axes it depends on the units of the commands.
    """
    return _largest_singular(sensitivity, _WHOLE)[0]


@jax.jit
def peaks_of(sensitivity: Sensitivity) -> Float[Array, " bands"]:
    """Return the largest singular value of S in each of ``BANDS`` bands.

    All bands meet a limit if and only if ``peak_of`` meets it. A search needs every
    band: where two peaks are equally high, the gradient of one contains nothing about
    the other, and a step that lowers the one is rejected because it raises the other.
    """
    return _largest_singular(sensitivity, _octaves(sensitivity.shape[0]))


def largest_by_band(values: Float[Array, " lines"]) -> Float[Array, " bands"]:
    """Return the largest of ``values`` in each band of ``peaks_of``."""
    return _largest_in(_octaves(values.size), values)


def _octaves(lines: int) -> list[slice]:
    """Return the bands of ``peaks_of``, each of one line or more."""
    ends = [max(lines >> (BANDS - band), band) for band in range(1, BANDS + 1)]
    return [*map(slice, (0, *ends[:-1]), ends)]


def _largest_in(
    bands: Sequence[slice], values: Float[Array, " lines"]
) -> Float[Array, " bands"]:
    return jnp.stack([largest(values[band]) for band in bands])


@jax.jit
def disk_margin_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return alpha = 1 / (largest singular value of (S - T)/2 over frequency).

    On one axis it is that of ``StabilityReport``. On several axes it is a lower bound
    of that of ``MultiAxisReport``, which scales the axes at each frequency.
    """
    shifted = sensitivity - 0.5 * jnp.eye(sensitivity.shape[-1])
    return 1.0 / _largest_singular(shifted, _WHOLE)[0]


def _largest_singular(
    matrices: Sensitivity, bands: Sequence[slice]
) -> Float[Array, " bands"]:
    """Return the largest singular value of ``matrices`` in each of the ``bands``.

    The derivatives are finite. On several axes it is the norm of order 2^25 of the
    singular values, which is never below the largest. Its derivative exists where
    singular values are equal, and it needs no LAPACK, whose calls from XLA may deadlock
    on a CPU.
    """
    if matrices.shape[-1] == 1:
        return _largest_in(bands, jnp.abs(matrices).ravel())
    sizes = jnp.exp(_log_norm(jax.lax.stop_gradient(matrices)))
    worst = [band.start + jnp.argmax(sizes[band]) for band in bands]
    return jnp.exp(_log_norm(matrices[jnp.stack(worst)]))


def _log_norm(matrix: Complex[Array, "*lines q q"]) -> Float[Array, "*lines"]:
    """Return ln (sum of sigma^(2p))^(1/(2p)) of the singular values, p = 2^24."""
    gram, found = _normalised(_product(jnp.conj(jnp.swapaxes(matrix, -1, -2)), matrix))

    def squared(gram: Array, weight: Scalar) -> tuple[Array, Array]:
        gram, log_trace = _normalised(_product(gram, gram))
        return gram, weight * log_trace

    weights = 0.5 ** jnp.arange(2.0, 2.0 + _SQUARINGS)
    return 0.5 * found + jnp.sum(jax.lax.scan(squared, gram, weights)[1], axis=0)


def _normalised(gram: Array) -> tuple[Array, Array]:
    """Return ``gram`` over its trace, and the logarithm of the trace."""
    trace = jnp.real(jnp.trace(gram, axis1=-2, axis2=-1))
    trace = jnp.maximum(trace, 1e-300)  # of a matrix of zeros
    return gram / trace[..., None, None], jnp.log(trace)


def _product(left: Array, right: Array) -> Array:
    return jnp.sum(left[..., :, :, None] * right[..., None, :, :], axis=-2)


@jax.jit
def gain_margin_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return the smallest gain above 1 that makes the loop unstable, in dB.

    ``UNLIMITED_GAIN`` if there is none. On several axes it is the smallest margin of
    one axis, with all others closed.
    """
    return _least_of_axes(_gain_margin, sensitivity)


def _gain_margin(sensitivity: Complex[Array, " lines"]) -> Float[Array, ""]:
    """Return the gain margin of one axis; crossings are interpolated."""
    loop = 1.0 / sensitivity - 1.0
    low, high = jnp.imag(loop[:-1]), jnp.imag(loop[1:])
    crosses = low * high < 0.0
    share = low / jnp.where(crosses, low - high, 1.0)
    real = jnp.real(loop[:-1]) + share * jnp.real(loop[1:] - loop[:-1])
    # L is real at the Nyquist frequency; a pole can leave the unit circle there too.
    real = jnp.append(real, jnp.real(loop[-1]))
    counts = jnp.append(crosses, True) & (real < 0.0) & (real > -1.0)
    factors = 1.0 / jnp.where(counts, -real, 1.0)
    decibel = 20.0 * jnp.log10(factors)
    return smallest(jnp.where(counts, decibel, UNLIMITED_GAIN))


@jax.jit
def phase_margin_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return the smallest phase, lag or lead, that makes the loop unstable, in degrees.

    180 if |L| never crosses 1. On several axes it is the smallest margin of one axis,
    with all others closed.
    """
    return _least_of_axes(_phase_margin, sensitivity)


def _phase_margin(sensitivity: Complex[Array, " lines"]) -> Float[Array, ""]:
    """Return the phase margin of one axis."""
    lag, _, crosses = _gain_crossings(sensitivity)
    either = jnp.minimum(lag, 2.0 * jnp.pi - lag)
    return smallest(jnp.where(crosses, jnp.degrees(either), 180.0))


@jax.jit
def delay_margin_of(sensitivity: Sensitivity) -> Float[Array, ""]:
    """Return the delay margin in samples, ``UNLIMITED_DELAY`` if |L| never crosses 1.

    On several axes it is the smallest margin of one axis, with all others closed.
    """
    return _least_of_axes(_delay_margin, sensitivity)


def _delay_margin(sensitivity: Complex[Array, " lines"]) -> Float[Array, ""]:
    """Return the delay margin of one axis."""
    lag, place, crosses = _gain_crossings(sensitivity)
    return smallest(jnp.where(crosses, lag / place, UNLIMITED_DELAY))


def _least_of_axes(
    margin: Callable[[Array], Array], sensitivity: Sensitivity
) -> Float[Array, ""]:
    """Return the least ``margin`` of the axes, 0 if an |S| exceeds ``NO_MARGIN``."""

    def left(axis: Complex[Array, " lines"]) -> Float[Array, ""]:
        return jnp.where(jnp.max(jnp.abs(axis)) > NO_MARGIN, 0.0, margin(axis))

    axes = jnp.diagonal(sensitivity, axis1=-2, axis2=-1)
    return smallest(jax.vmap(left, in_axes=-1)(axes))


def _gain_crossings(
    sensitivity: Complex[Array, " lines"],
) -> tuple[Array, Array, Array]:
    """Return phase and frequency (rad/sample) at which |L| = 1 between two lines.

    The phase (rad) is the lag that would move L to -1. Both are interpolated. The third
    array is True between the lines where |L| crosses 1.
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
    return there, angle[:-1] + share * (angle[1:] - angle[:-1]), crosses


@jax.jit
def bandwidth_of(
    followed: Complex[Array, " lines"], dt: ScalarLike
) -> Float[Array, ""]:
    """Return the lowest frequency, Hz, at which |y/r| falls below -3 dB.

    It is interpolated between two lines. If |y/r| does not fall below -3 dB, it is the
    Nyquist frequency. If |y/r| is below -3 dB at 0 Hz already, it is 1e-3 of the line
    spacing, so that its logarithm is finite.
    """
    gain = jnp.log(jnp.abs(followed)) - BAND
    below = gain < 0.0
    at = jnp.argmax(below)
    before = jnp.maximum(at - 1, 0)
    share = gain[before] / jnp.where(gain[before] > 0.0, gain[before] - gain[at], 1.0)
    line = before + jnp.where(gain[before] > 0.0, share, 1e-3)
    line = jnp.where(jnp.any(below), line, followed.size - 1.0)
    return line / (2.0 * dt * (followed.size - 1))


@jax.jit
def closed_loop_peak_of(followed: Complex[Array, " lines"]) -> Float[Array, ""]:
    """Return the largest |y/r|."""
    return largest(jnp.abs(followed))
