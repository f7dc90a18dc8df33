"""Filters with frequencies in Hz: low-passes, biquad and notch, with unit DC gain.

Each is the bilinear transform of a continuous filter, prewarped so that its frequencies
are exact. The sections are integrators by the trapezoidal rule: unlike the coefficients
of a difference equation they keep the DC gain exactly at frequencies far below the
rate. They use sine and cosine in place of the tangent of the prewarped frequency, so
that numbers and derivatives stay finite up to the Nyquist frequency.
"""

import math

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.parameter import parameter, sample_time
from ..core.system import Designed, System


def _frequency(meaning: str):
    return parameter(
        "Hz",
        meaning,
        above=0.0,
        below_nyquist=True,
        scale="log",
        typical=(1e1, 1e5),
    )


def _damping(meaning: str):
    return parameter("1", meaning, above=0.0, scale="log", typical=(1e-2, 2.0))


def _warped(frequency: Scalar, dt: float) -> tuple[Scalar, Scalar]:
    """Return sine and cosine of pi ``frequency`` dt; their ratio prewarps it."""
    angle = math.pi * dt * frequency
    return jnp.sin(angle), jnp.cos(angle)


class FirstOrderLowPass(Designed):
    """``1 / (1 + s / w)`` with w = 2 pi frequency: the gain is -3 dB at ``frequency``.

    Input and output have the same unit. Raises ValueError for a frequency that is not
    between 0 and the Nyquist frequency.
    """

    frequency: Scalar = _frequency("cut-off frequency")
    dt: float = sample_time()

    def resolved(self) -> "FirstOrderSection":
        """Return the section with its coefficient."""
        sine, cosine = _warped(self.frequency, self.dt)
        return FirstOrderSection(sine / (sine + cosine))


class SecondOrderLowPass(Designed):
    """``w^2 / (s^2 + 2 damping w s + w^2)`` with w = 2 pi frequency.

    With a damping of 0.707 it is a Butterworth filter, with -3 dB at ``frequency``.
    Input and output have the same unit. Raises ValueError for parameters outside their
    limits.
    """

    frequency: Scalar = _frequency("undamped natural frequency")
    damping: Scalar = _damping("damping ratio")
    dt: float = sample_time()

    def resolved(self) -> "SecondOrderSection":
        """Return the section with its coefficients."""
        return _section(*_warped(self.frequency, self.dt), self.damping, 0.0, 0.0)


class Biquad(Designed):
    """``(s^2/v^2 + 2 zero_damping s/v + 1) / (s^2/w^2 + 2 damping s/w + 1)``.

    v = 2 pi zero_frequency, w = 2 pi frequency. With its zeros on a resonance of the
    stage, the filter replaces the poles of that resonance by its own. Input and output
    have the same unit. Raises ValueError for parameters outside their limits.
    """

    zero_frequency: Scalar = _frequency("frequency of the zeros")
    zero_damping: Scalar = parameter(
        "1", "damping ratio of the zeros", least=0.0, scale="log", typical=(1e-2, 2.0)
    )
    frequency: Scalar = _frequency("frequency of the poles")
    damping: Scalar = _damping("damping ratio of the poles")
    dt: float = sample_time()

    def resolved(self) -> "SecondOrderSection":
        """Return the section with its coefficients."""
        sine, cosine = _warped(self.frequency, self.dt)
        zero_sine, zero_cosine = _warped(self.zero_frequency, self.dt)
        ratio = sine * zero_cosine / (cosine * zero_sine)
        middle = 2.0 * self.zero_damping * ratio
        return _section(sine, cosine, self.damping, middle, ratio**2)


class Notch(Designed):
    """``(s^2 + 2 depth damping w s + w^2) / (s^2 + 2 damping w s + w^2)``.

    w = 2 pi frequency. The gain is ``depth`` at ``frequency`` and 1 far from it, so a
    depth of 1 switches the notch off. With a depth of 0 the gain is below -3 dB over a
    width of 2 damping frequency (in Hz, for frequencies far below the rate). Input and
    output have the same unit. Raises ValueError for parameters outside their limits.
    """

    frequency: Scalar = _frequency("frequency of the notch")
    damping: Scalar = _damping("damping ratio of the poles, which sets the width")
    depth: Scalar = parameter(
        "1", "gain at the frequency of the notch", least=0.0, typical=(0.0, 1.0)
    )
    dt: float = sample_time()

    def resolved(self) -> "SecondOrderSection":
        """Return the section with its coefficients."""
        sine, cosine = _warped(self.frequency, self.dt)
        middle = 2.0 * self.depth * self.damping
        return _section(sine, cosine, self.damping, middle, 1.0)


class FirstOrderSection(System):
    """Trapezoidal low-pass ``y = state + share (x - state)``, the resolved filter."""

    share: Scalar

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        change = self.share * (input - state)
        output = state + change
        return output + change, output


class SecondOrderSection(System):
    """Two trapezoidal integrators, whose states are the band-pass and the low-pass.

    The outputs of the high-pass and the band-pass, with the gains ``high`` and
    ``middle``, are added to that of the low-pass. ``square``, ``mixed`` and ``rest``
    are cos^2, sin cos and sin^2 of pi frequency dt, divided by 1 + 2 damping sin cos;
    ``damped`` is twice the damping.
    """

    square: Scalar
    mixed: Scalar
    rest: Scalar
    damped: Scalar
    middle: Scalar
    high: Scalar

    def init(self, input: ScalarLike = 0.0) -> tuple[Scalar, Scalar]:
        low = as_array(input)
        return jnp.zeros_like(low), low

    def step(
        self, state: tuple[Scalar, Scalar], input: ScalarLike
    ) -> tuple[tuple[Scalar, Scalar], Scalar]:
        band, low = state
        distance = input - low
        middle = self.square * band + self.mixed * distance
        change = self.mixed * band + self.rest * distance
        high = self.square * distance - (self.damped * self.square + self.mixed) * band
        output = low + change + self.middle * middle + self.high * high
        return (2.0 * middle - band, low + 2.0 * change), output


def _section(
    sine: Scalar, cosine: Scalar, damping: Scalar, middle: ScalarLike, high: ScalarLike
) -> SecondOrderSection:
    scale = 1.0 / (1.0 + 2.0 * damping * sine * cosine)
    return SecondOrderSection(
        square=scale * cosine**2,
        mixed=scale * sine * cosine,
        rest=scale * sine**2,
        damped=2.0 * damping,
        middle=as_array(middle),
        high=as_array(high),
    )
