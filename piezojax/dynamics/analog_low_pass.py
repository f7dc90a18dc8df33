"""Low-pass of analogue electronics: an amplifier, a sensor, an anti-aliasing filter."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from ..core.arrays import Scalar, ScalarLike, State, as_array
from ..core.axes import Plain, Rows
from ..core.parameter import parameter, sample_time
from ..core.system import Designed, System


class AnalogLowPass(Designed):
    """Butterworth low-pass of order 1 to 4 with unit DC gain.

    Its gain is -3 dB at ``bandwidth``, which may lie above the Nyquist frequency. Input
    and output have the same unit. The step is exact for an input that is linear between
    samples, as a displacement nearly is. For an input held between samples, such as
    that of an amplifier, the output is the mean of the true output over the sample that
    begins. A plant that holds this mean moves correctly on average. Raises ValueError
    for parameters outside their limits.
    """

    bandwidth: Scalar = parameter(
        "Hz",
        "frequency at which the gain is -3 dB",
        least=1e-3,
        most=1e9,
        scale="log",
        typical=(1e1, 1e5),
    )
    dt: float = sample_time()
    order: int = parameter(
        "1", "order", least=1.0, most=4.0, whole=True, static=True, default=1
    )

    def resolved(self) -> "ParallelLags":
        """Return the lags of the partial fractions.

        Let p be a pole times dt. In one sample the deviation of its lag is multiplied
        by exp(p), and a rise of the input adds -(exp(p) - 1) / p times the rise.
        """
        poles, weights = _partial_fractions(self.order)
        p = 2.0 * math.pi * self.bandwidth * self.dt * poles
        return ParallelLags(
            _parts(jnp.exp(p), poles),
            _parts(jnp.expm1(p) / p, poles),
            _parts(jnp.asarray(weights), poles),
        )


class ParallelLags(System):
    """First-order lags in parallel, the resolved AnalogLowPass.

    The state is the last input and the deviation of each lag from it. A real lag is one
    number; a conjugate pair is one complex number, as real and imaginary part. In one
    sample ``keep`` multiplies the deviation and ``slip`` the rise of the input. The
    output is the input plus the real part of the sum of ``weight`` times deviation.
    """

    keep: Rows
    slip: Rows
    weight: Rows

    def init(self, input: ScalarLike = 0.0) -> State:
        input = as_array(input)
        return input, jax.tree.map(lambda _: jnp.zeros_like(input), self.keep)

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        last, deviations = state
        input = as_array(input)
        rise = input - last
        output, moved = input, []
        for deviation, keep, slip, weight in zip(
            deviations, self.keep, self.slip, self.weight, strict=True
        ):
            kept = _times(keep, deviation)
            moved.append(tuple(k - s * rise for k, s in zip(kept, slip, strict=True)))
            output = output + _times(weight, moved[-1])[0]
        return (input, tuple(moved)), output


def _partial_fractions(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return poles of the filter with cut-off 1 rad/s and the weights of their lags.

    Of a conjugate pair only the upper pole is listed, with twice the weight.
    """
    every = np.exp(0.5j * np.pi * (2.0 * np.arange(order) + order + 1) / order)
    apart = every[:, None] - every + np.eye(order)
    weights = -1.0 / (every * np.prod(apart, axis=1))
    real = np.abs(np.imag(every)) < 1e-9
    upper = real | (np.imag(every) > 0.0)
    return every[upper], np.where(real, 1.0, 2.0)[upper] * weights[upper]


def _parts(values: jax.Array, poles: np.ndarray) -> Rows:
    """Return the real part of each value and, for complex poles, the imaginary part."""
    return tuple(
        (value.real,) if abs(pole.imag) < 1e-9 else (value.real, value.imag)
        for value, pole in zip(values, poles, strict=True)
    )


def _times(left: Plain, right: Plain) -> Plain:
    """Return the product of two real or two complex numbers."""
    if len(left) == 1:
        return (left[0] * right[0],)
    return (
        left[0] * right[0] - left[1] * right[1],
        left[0] * right[1] + left[1] * right[0],
    )
