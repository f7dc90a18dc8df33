"""Differentiable margins of a loop, from samples of its sensitivity over frequency."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ...core.arrays import Scalar, ScalarLike, largest, smallest
from ...core.feedback import Feedback
from .small_motion import Sensitivity, sensitivity

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

BANDS = 10
"""Number of bands of ``peaks_of``: octaves down from the Nyquist frequency, and one
band below them."""

_WHOLE = (slice(0, None),)

_SQUARINGS = 24
"""Number of squarings of a Gram matrix that give its largest eigenvalue, with a
relative error of at most ln(axes) / 2^24."""


def sensitivity_peak(
    loop: Feedback, at: Any = 0.0, duration: float | None = None
) -> Float[Array, ""]:
    """Return Ms as ``peak_of`` does; the arguments are those of ``sensitivity``."""
    return peak_of(sensitivity(loop, at, duration))


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
