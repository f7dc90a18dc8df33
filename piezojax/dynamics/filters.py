"""Filters with frequencies in Hz: low-pass, high-pass, lead-lag, biquad and notch.

Each is a section of first or second order, or a chain of them. A section is a
continuous filter, discretised by one of these methods:

- ``bilinear``: the bilinear transform, prewarped so that its frequencies are exact;
- ``hold``: zero-order hold, exact for a section whose input is held between samples;
- ``matched``: poles and zeros are those of the continuous section, z = exp(s dt); zeros
  at infinity go to z = -1, and the gain is exact at 0 Hz, or at the Nyquist frequency
  for a high-pass (Franklin, Powell and Workman, Digital Control of Dynamic Systems,
  1998, section 6.1).

At rest one state of a section equals its input; the other, if any, is 0. In this form,
unlike in that of a difference equation, the DC gain stays exact for cut-off frequencies
far below the sampling rate. Coefficients and derivatives are finite up to the Nyquist
frequency: sine and cosine replace the tangent of the prewarped frequency.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check_option
from ..core.parameter import parameter, sample_time
from ..core.system import Designed, Series, System

METHODS = ("bilinear", "hold", "matched")
"""Names of the discretisations."""

KINDS = ("butterworth", "equal poles")
"""Kinds of low-pass and high-pass."""


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


def _order():
    return parameter(
        "1", "order", least=1.0, most=8.0, whole=True, static=True, default=1
    )


class _Filter(Designed):
    """Filter whose sections are discretised by one method."""

    def __check_init__(self):
        for field, allowed in (("discretisation", METHODS), ("kind", KINDS)):
            check_option(field, getattr(self, field, allowed[0]), allowed)


class _Pass(_Filter):
    """Low-pass or high-pass of order 1 to 8."""

    frequency: Scalar = _frequency("cut-off frequency")
    dt: float = sample_time()
    order: int = _order()
    kind: str = eqx.field(static=True, default="butterworth")
    discretisation: str = eqx.field(static=True, default="bilinear")


class LowPass(_Pass):
    """Low-pass of order 1 to 8 with unit DC gain and -3 dB at ``frequency``.

    The gain at ``frequency`` is exact for the bilinear transform. The ``kind`` is
    "butterworth" or "equal poles", all real. Input and output have the same unit.
    Raises ValueError for parameters outside their limits and for an unknown ``kind`` or
    ``discretisation``.
    """

    def resolved(self) -> System:
        """Return the sections with their coefficients."""
        place = _Place.at(self.frequency, self.dt, _spread(self.kind, self.order))
        return _chain(self, place, low=1.0, high=0.0)


class HighPass(_Pass):
    """High-pass of order 1 to 8 with -3 dB at ``frequency`` and a gain of 0 at 0 Hz.

    The gain is 1 far above ``frequency``. Kinds, units and errors are those of LowPass.
    """

    def resolved(self) -> System:
        """Return the sections with their coefficients."""
        spread = 1.0 / _spread(self.kind, self.order)
        return _chain(
            self, _Place.at(self.frequency, self.dt, spread), low=0.0, high=1.0
        )


class SecondOrderLowPass(_Filter):
    """``w^2 / (s^2 + 2 damping w s + w^2)`` with w = 2 pi frequency.

    Unlike LowPass it has a damping ratio to tune. Input and output have the same unit.
    Raises ValueError for parameters outside their limits.
    """

    frequency: Scalar = _frequency("undamped natural frequency")
    damping: Scalar = _damping("damping ratio")
    dt: float = sample_time()
    discretisation: str = eqx.field(static=True, default="bilinear")

    def resolved(self) -> "SecondOrderSection":
        """Return the section with its coefficients."""
        place = _Place.at(self.frequency, self.dt)
        return _second_order(self.discretisation, place, self.damping, (1.0, 0.0, 0.0))


class FirstOrderLeadLag(_Filter):
    """``(s/v + 1) / (s/w + 1)`` with v = 2 pi zero_frequency, w = 2 pi frequency.

    It is a lead if the zero lies below the pole. The gain is 1 at 0 Hz and w/v far
    above both. Input and output have the same unit. Raises ValueError for parameters
    outside their limits.
    """

    zero_frequency: Scalar = _frequency("frequency of the zero")
    frequency: Scalar = _frequency("frequency of the pole")
    dt: float = sample_time()
    discretisation: str = eqx.field(static=True, default="bilinear")

    def resolved(self) -> "FirstOrderSection":
        """Return the section with its coefficients."""
        place = _Place.at(self.frequency, self.dt)
        zero = _Place.at(self.zero_frequency, self.dt)
        high = place.ratio(zero, self.discretisation)
        return _first_order(self.discretisation, place, 1.0, high, zero)


class Biquad(_Filter):
    """``(s^2/v^2 + 2 zero_damping s/v + 1) / (s^2/w^2 + 2 damping s/w + 1)``.

    v = 2 pi zero_frequency, w = 2 pi frequency. With its complex zeros on a resonance
    of the stage, the filter replaces the poles of that resonance by its own. Input and
    output have the same unit. Raises ValueError for parameters outside their limits.
    """

    zero_frequency: Scalar = _frequency("frequency of the zeros")
    zero_damping: Scalar = parameter(
        "1", "damping ratio of the zeros", least=0.0, scale="log", typical=(1e-2, 2.0)
    )
    frequency: Scalar = _frequency("frequency of the poles")
    damping: Scalar = _damping("damping ratio of the poles")
    dt: float = sample_time()
    discretisation: str = eqx.field(static=True, default="bilinear")

    def resolved(self) -> "SecondOrderSection":
        """Return the section with its coefficients."""
        place = _Place.at(self.frequency, self.dt)
        zero = _Place.at(self.zero_frequency, self.dt)
        ratio = place.ratio(zero, self.discretisation)
        shape = 1.0, 2.0 * self.zero_damping * ratio, ratio**2
        zeros = _Decay.of(zero.angle, self.zero_damping)
        return _second_order(self.discretisation, place, self.damping, shape, zeros)


class Notch(_Filter):
    """``(s^2 + 2 depth damping w s + w^2) / (s^2 + 2 damping w s + w^2)``.

    w = 2 pi frequency. The gain is ``depth`` at ``frequency`` and 1 far from it, so a
    depth of 1 switches the notch off. With a depth of 0 the gain is below -3 dB over a
    width of 2 damping frequency (in Hz, for frequencies far below the sampling rate).
    Input and output have the same unit. Raises ValueError for parameters outside their
    limits.
    """

    frequency: Scalar = _frequency("frequency of the notch")
    damping: Scalar = _damping("damping ratio of the poles, which sets the width")
    depth: Scalar = parameter(
        "1", "gain at the frequency of the notch", least=0.0, typical=(0.0, 1.0)
    )
    dt: float = sample_time()
    discretisation: str = eqx.field(static=True, default="bilinear")

    def resolved(self) -> "SecondOrderSection":
        """Return the section with its coefficients."""
        place = _Place.at(self.frequency, self.dt)
        inner = self.depth * self.damping
        shape, zeros = (1.0, 2.0 * inner, 1.0), _Decay.of(place.angle, inner)
        return _second_order(self.discretisation, place, self.damping, shape, zeros)


class FirstOrderSection(System):
    """Section with one state, which follows the input: a resolved filter.

    In a sample the state moves by ``share`` of its distance from the input. The output
    is ``low`` times the state plus ``direct`` times the distance.
    """

    share: Scalar
    low: Scalar
    direct: Scalar

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        distance = input - state
        output = self.low * state + self.direct * distance
        return state + self.share * distance, output


class SecondOrderSection(System):
    """Section with two states, the band-pass and the low-pass: a resolved filter.

    In a sample the band-pass becomes ``keep`` times itself plus ``couple`` times the
    distance of the low-pass from the input; the low-pass moves by ``couple`` times the
    band-pass plus ``share`` of its distance. The output is ``middle`` times the
    band-pass, ``low`` times the low-pass and ``direct`` times the distance.
    """

    keep: Scalar
    couple: Scalar
    share: Scalar
    low: Scalar
    middle: Scalar
    direct: Scalar

    def init(self, input: ScalarLike = 0.0) -> tuple[Scalar, Scalar]:
        low = as_array(input)
        return jnp.zeros_like(low), low

    def step(
        self, state: tuple[Scalar, Scalar], input: ScalarLike
    ) -> tuple[tuple[Scalar, Scalar], Scalar]:
        band, low = state
        distance = input - low
        output = self.low * low + (self.middle * band + self.direct * distance)
        band, low = (
            self.keep * band + self.couple * distance,
            low + (self.couple * band + self.share * distance),
        )
        return (band, low), output


# Poles and zeros of sections


class _Place(NamedTuple):
    """Frequency w of poles or zeros.

    ``sine`` / ``cosine`` is the prewarped frequency, ``angle`` is w dt.
    """

    sine: Scalar
    cosine: Scalar
    angle: Scalar

    @classmethod
    def at(cls, frequency: Scalar, dt: float, spread: float = 1.0) -> "_Place":
        """Return poles at ``spread`` times a prewarped ``frequency``."""
        half = math.pi * dt * frequency
        return cls(spread * jnp.sin(half), jnp.cos(half), 2.0 * spread * half)

    def ratio(self, zero: "_Place", method: str) -> Scalar:
        """Return this frequency over that of ``zero``, both prewarped if bilinear."""
        if method != "bilinear":
            return self.angle / zero.angle
        return self.sine * zero.cosine / (self.cosine * zero.sine)


def _spread(kind: str, order: int) -> float:
    """Return the natural frequency of a low-pass's poles over its cut-off frequency."""
    return 1.0 if kind == "butterworth" else 1.0 / math.sqrt(2.0 ** (1.0 / order) - 1.0)


def _chain(filter: _Pass, place: _Place, *, low: float, high: float) -> System:
    """Return the sections of a filter with poles at ``place``."""
    order, method = filter.order, filter.discretisation
    angles = [math.pi * (0.5 + k) / order for k in range(order // 2)]
    butterworth = filter.kind == "butterworth"
    parts: list[System] = [
        _second_order(
            method,
            place,
            as_array(math.sin(angle) if butterworth else 1.0),
            (low, 0.0, high),
        )
        for angle in angles
    ]
    if order % 2:
        parts.append(_first_order(method, place, low, high, None))
    return parts[0] if len(parts) == 1 else Series(tuple(parts))


def _first_order(
    method: str, place: _Place, low: float, high: ScalarLike, zero: _Place | None
) -> FirstOrderSection:
    """Return ``(high s/w + low) / (s/w + 1)``.

    ``zero`` is the zero of a matched section if it is finite and not 0, else None.
    """
    if method == "bilinear":
        share = place.sine / (place.sine + place.cosine)
        direct = low * share + high * (1.0 - share)
        return FirstOrderSection(2.0 * share, as_array(low), direct)
    share = -jnp.expm1(-place.angle)
    if method == "hold":
        direct = as_array(high)
    elif low:
        direct = low * share / (2.0 if zero is None else -jnp.expm1(-zero.angle))
    else:
        direct = 0.5 * high * (2.0 - share)
    return FirstOrderSection(share, as_array(low), direct)


def _second_order(
    method: str,
    place: _Place,
    damping: Scalar,
    shape: tuple[float, ScalarLike, ScalarLike],
    zeros: "_Decay | None" = None,
) -> SecondOrderSection:
    """Return ``(high s^2/w^2 + middle s/w + low) / (s^2/w^2 + 2 damping s/w + 1)``.

    ``shape`` is (low, middle, high). ``zeros`` are those of a matched section if they
    are finite and not 0, else None.
    """
    low, middle, high = shape
    if method == "bilinear":
        sine, cosine = place.sine, place.cosine
        scale = 1.0 / (cosine**2 + 2.0 * damping * sine * cosine + sine**2)
        square, mixed, rest = scale * cosine**2, scale * sine * cosine, scale * sine**2
        return SecondOrderSection(
            keep=2.0 * square - 1.0,
            couple=2.0 * mixed,
            share=2.0 * rest,
            low=as_array(low),
            middle=low * mixed
            + middle * square
            - high * (2.0 * damping * square + mixed),
            direct=low * rest + middle * mixed + high * square,
        )
    shift, decayed = damping * place.angle, _Decay.of(place.angle, damping)
    keep = decayed.even - shift * decayed.odd
    couple = place.angle * decayed.odd
    share = decayed.gone - decayed.excess - shift * decayed.odd
    if method == "hold":
        across = middle - 2.0 * damping * high
        return SecondOrderSection(
            keep, couple, share, as_array(low), across, as_array(high)
        )
    if low:
        direct = low * decayed.at_dc / (4.0 if zeros is None else zeros.at_dc)
        last = 1.0 if zeros is None else zeros.product
    else:
        direct, last = 0.25 * high * decayed.at_nyquist, 1.0
    product = decayed.product
    rest = direct * (last - product) - (low - direct) * (product - keep)
    return SecondOrderSection(
        keep, couple, share, as_array(low), -rest / couple, direct
    )


class _Decay(NamedTuple):
    """Functions of a pair of roots over one sample, exact for slow roots too.

    With s = damping angle and r^2 = (damping^2 - 1) angle^2 of either sign: ``gone`` is
    1 - exp(-s), ``excess`` exp(-s) (cosh(r) - 1) and ``odd`` exp(-s) sinh(r)/r.
    """

    gone: Scalar
    excess: Scalar
    odd: Scalar

    @classmethod
    def of(cls, angle: Scalar, damping: Scalar) -> "_Decay":
        shift, square = damping * angle, (damping**2 - 1.0) * angle**2
        near = jnp.abs(square) < _NEAR
        size = jnp.sqrt(jnp.where(near, 1.0, jnp.abs(square)))
        decay = jnp.exp(-shift)
        slow, fast = jnp.exp(size - shift), jnp.exp(-size - shift)
        real = square > 0.0
        excess = jnp.where(
            real, 0.5 * (slow + fast) - decay, decay * (jnp.cos(size) - 1.0)
        )
        odd = jnp.where(real, 0.5 * (slow - fast), decay * jnp.sin(size)) / size
        series = [1.0, 1.0]
        for power in range(5, 0, -1):
            even_term = square / ((2 * power + 1) * (2 * power + 2))
            odd_term = square / (2 * power * (2 * power + 1))
            series = [1.0 + even_term * series[0], 1.0 + odd_term * series[1]]
        return cls(
            -jnp.expm1(-shift),
            jnp.where(near, 0.5 * decay * square * series[0], excess),
            jnp.where(near, decay * series[1], odd),
        )

    @property
    def even(self) -> Scalar:
        """exp(-s) cosh(r): half the sum of the roots in the z plane."""
        return 1.0 - self.gone + self.excess

    @property
    def product(self) -> Scalar:
        """Product of the roots in the z plane."""
        return (1.0 - self.gone) ** 2

    @property
    def at_dc(self) -> Scalar:
        """Value at z = 1 of the monic polynomial with these roots."""
        return self.gone**2 - 2.0 * self.excess

    @property
    def at_nyquist(self) -> Scalar:
        """Value at z = -1 of the monic polynomial with these roots."""
        return 1.0 + 2.0 * self.even + self.product


_NEAR = 1e-2
"""Size of r^2 below which series replace the functions."""
