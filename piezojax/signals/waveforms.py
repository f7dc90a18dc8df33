"""Reference and excitation signals: functions of time that ``jax.vmap`` can batch.

Each takes ``time`` in s and parameters that may be arrays: ``frequency`` in Hz,
``amplitude`` and ``offset`` in um (or in V, for an excitation).
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import ScalarLike, as_array, check
from ..core.plain import shown

Time = Float[Array, " samples"]


def time_grid(duration: float, rate: float) -> Time:
    """Return the sample instants 0, 1/rate, ... of ``duration`` s at ``rate`` Hz.

    Raises ValueError unless both are positive and at least two samples result.
    """
    check("duration in s", duration, above=0.0)
    check("rate in Hz", rate, above=0.0)
    samples = round(duration * rate)
    if samples < 2:
        raise ValueError(
            f"{duration:g} s at {rate:g} Hz hold {samples} samples; "
            "at least 2 are needed"
        )
    return as_array(np.arange(samples) / rate)


def _reached(periods: Time) -> Time:
    """Return a number of periods for signals that jump, a billionth larger.

    Rounding would otherwise delay some jumps by a sample.
    """
    return periods + 1e-9


@jax.jit
def constant(
    time: Time,
    frequency: ScalarLike = 0.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """Hold ``offset + amplitude``."""
    return jnp.full_like(time, 1.0) * (offset + amplitude)


@jax.jit
def step(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """Step from ``offset`` up by ``amplitude`` after a tenth of a period."""
    return offset + amplitude * (_reached(time * frequency) >= 0.1).astype(time.dtype)


@jax.jit
def square(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """Alternate between ``offset`` and ``offset + 2 amplitude``."""
    high = jnp.mod(_reached(time * frequency), 1.0) >= 0.5
    return offset + 2.0 * amplitude * high.astype(time.dtype)


@jax.jit
def triangle(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """Scan up and down between ``offset`` and ``offset + 2 amplitude``."""
    phase = jnp.mod(time * frequency, 1.0)
    return offset + 2.0 * amplitude * (1.0 - jnp.abs(2.0 * phase - 1.0))


@jax.jit
def sine(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """SIN: ``offset + A (1 - cos 2 pi f t)``, at rest at its start (section 5.5.6)."""
    return offset + amplitude * (1.0 - jnp.cos(2.0 * jnp.pi * frequency * time))


@jax.jit
def cosine(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """COS: SIN advanced by a quarter of a period; it starts mid-range at full speed.

    With SIN on another axis it gives a circle around the middle of both ranges.
    """
    return offset + amplitude * (1.0 + jnp.sin(2.0 * jnp.pi * frequency * time))


@partial(jax.jit, static_argnames="turnaround")
def scan(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
    turnaround: float = 0.1,
) -> Time:
    """SCAN: triangle with rounded turns, at rest at its start.

    Each of the two turns takes the share ``turnaround`` of the period, at constant
    acceleration. The range is ``offset`` to ``offset + 2 amplitude``, as for the
    triangle. Raises ValueError for a share outside 0 to 0.5.
    """
    check("turnaround", turnaround, least=0.0, most=0.5)
    half = 0.5 * turnaround
    below = 0.5 - jnp.abs(jnp.mod(time * frequency, 1.0) - 0.5)  # 0.5 at the top
    near = jnp.minimum(below, 0.5 - below)  # from the nearer turn
    speed = amplitude / (0.25 - 0.5 * half)
    turning = near**2 / (2.0 * half) if half > 0.0 else near
    gone = speed * jnp.where(near < half, turning, near - 0.5 * half)
    return offset + jnp.where(below <= 0.25, gone, 2.0 * amplitude - gone)


@jax.jit
def piecewise_sine(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """PWSW: periods of the sine at 100, 100, 50 and 15 % of A, repeated."""
    period = jnp.floor(_reached(time * frequency)).astype(jnp.int32) % 4
    share = jnp.asarray([1.0, 1.0, 0.5, 0.15])[period]
    return offset + share * (sine(time, frequency, amplitude))


@jax.jit
def superposed_sine(
    time: Time,
    frequency: ScalarLike = 10.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """SW, (4.48): four sines up to ``frequency``; A = 5 um as printed.

    Swings from -2.3 to 12.9 um at A = 5 um. (Chapter 7 prints the same signal.)
    """
    t = time - 0.1
    parts = (
        (30.0, 20.0, 1.0),
        (25.0, 5.0, 0.5),
        (5.0, 2.0, 0.2),
        (5.0, 1.0, 0.0),
    )  # amplitude * 7, frequency divisor, phase / pi
    total = jnp.full_like(time, 5.0)
    for weight, divisor, phase in parts:
        total = total + weight / 7.0 * jnp.sin(
            2.0 * jnp.pi * frequency / divisor * t + phase * jnp.pi
        )
    return offset + amplitude / 5.0 * total


@jax.jit
def chirp(
    time: Time,
    frequency: ScalarLike = 100.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
) -> Time:
    """Sweep the frequency linearly from 0 to ``frequency`` at the last sample."""
    phase = 0.5 * frequency * time**2 / time[-1]
    return offset + amplitude * (1.0 - jnp.cos(2.0 * jnp.pi * phase))


@partial(jax.jit, static_argnames="tones")
def multisine(
    time: Time,
    frequency: ScalarLike = 100.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
    tones: int = 20,
) -> Time:
    """Equal tones up to ``frequency``, with Schroeder phases.

    The largest deviation from ``offset`` is about ``amplitude``.
    """
    number = jnp.arange(1, tones + 1)
    phase = -jnp.pi * number * (number - 1) / tones
    angle = 2.0 * jnp.pi * frequency * jnp.outer(time, number / tones) + phase
    return offset + amplitude * jnp.cos(angle).sum(axis=1) / (1.7 * np.sqrt(tones / 2))


@partial(jax.jit, static_argnames="seed")
def prbs(
    time: Time,
    frequency: ScalarLike = 100.0,
    amplitude: ScalarLike = 5.0,
    offset: ScalarLike = 0.0,
    seed: int = 0,
) -> Time:
    """Pseudo-random binary signal of ``offset`` plus 0 or ``2 amplitude``.

    Each value is held for 1/``frequency`` s.
    """
    bits = np.random.default_rng(seed).integers(0, 2, 4096)
    slot = jnp.floor(_reached(time * frequency)).astype(jnp.int32) % bits.size
    return offset + 2.0 * amplitude * jnp.asarray(bits, time.dtype)[slot]


SIGNALS: dict[str, Callable[..., Time]] = {
    "SIN": sine,
    "SW": superposed_sine,
    "PWSW": piecewise_sine,
    "TRI": triangle,
    "STEP": step,
    "SQUARE": square,
    "CONST": constant,
    "CHIRP": chirp,
    "MULTISINE": multisine,
    "PRBS": prbs,
    "COS": cosine,
    "SCAN": scan,
}
"""Signals by name in a study; a number after it is the frequency in Hz: ``SIN10``."""

THESIS = (
    "SIN1",
    "SIN10",
    "SIN30",
    "SIN50",
    "SW10",
    "SW30",
    "SW50",
    "PWSW10",
    "PWSW30",
    "PWSW50",
)
"""The ten references of Tables 4-5 to 5-5."""


def parse(name: str) -> tuple[str, float | None]:
    """Split ``"PWSW30"`` into ``("PWSW", 30.0)``; without a number the second is None.

    Raises ValueError, listing the signals, for an unknown name.
    """
    kind = name.rstrip("0123456789.")
    digits = name[len(kind) :]
    if kind not in SIGNALS or digits.count(".") > 1 or digits == ".":
        raise ValueError(
            f"signal {shown(name)} is unknown; it must be one of {', '.join(SIGNALS)}, "
            "followed by its frequency in Hz, as in SIN10"
        )
    return kind, float(digits) if digits else None


def signal(
    name: str, time: Time, amplitude: ScalarLike = 5.0, offset: ScalarLike = 0.0
) -> Time:
    """Return the signal called ``name``, such as ``"SIN10"``, on ``time``."""
    kind, frequency = parse(name)
    options = {} if frequency is None else {"frequency": frequency}
    return SIGNALS[kind](time, amplitude=amplitude, offset=offset, **options)
