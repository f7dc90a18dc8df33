"""Contours: paths of two axes in time, and their names in a motion.

A named contour stands for two signals of ``piezojax.signals``: ``Rx+Ry:CIRCLE5`` is a
shorthand for ``Rx:SIN5 Ry:COS5``. A loop starts at rest at the first point of the
contour, so only the velocity of its reference jumps at the start. It does not jump on
an axis that follows SIN, SCAN or the steps of a raster, nor with ``rise`` in the
functions below.
"""

import math
import re
from decimal import Decimal
from fractions import Fraction

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import ScalarLike, check
from ..core.plain import shown
from . import waveforms as signals

Path = Float[Array, "samples 2"]
Pair = ScalarLike | tuple[ScalarLike, ScalarLike]
"""One value for both axes, or a pair of values."""

LINES = 20
"""Default number of lines of a raster."""

FORMS = ("CIRCLE5", "LISSAJOUS5/4", "RASTER10", "RASTER10/0.5")
"""Examples of contour names; the numbers are frequencies in Hz, one per axis if two."""


def circle(
    time: signals.Time,
    frequency: ScalarLike = 10.0,
    amplitude: Pair = 5.0,
    offset: Pair = 0.0,
    rise: float = 0.0,
) -> Path:
    """Return a circle about ``offset + amplitude``; for two amplitudes, an ellipse.

    It runs clockwise from the middle of its left side, seen with the first axis to the
    right and the second up. ``frequency`` in Hz; ``amplitude``, the radius, and
    ``offset`` in the unit of the axes. The speed rises linearly from 0 over the first
    ``rise`` s. Differentiable in all but ``rise``. Raises ValueError for a ``rise``
    below 0.
    """
    return lissajous(time, frequency, (1, 1), amplitude, offset, rise)


def lissajous(
    time: signals.Time,
    frequency: ScalarLike = 1.0,
    cycles: tuple[int, int] = (5, 4),
    amplitude: Pair = 5.0,
    offset: Pair = 0.0,
    rise: float = 0.0,
) -> Path:
    """Return the Lissajous figure that closes after 1/``frequency`` s.

    In this time the axes complete ``cycles`` periods, one as SIN and the other as COS,
    in the order for which the figure does not retrace itself. Other arguments as for
    ``circle``. Raises ValueError for cycles that are not whole, positive and without
    common factor.
    """
    whole = all(isinstance(count, int) and count > 0 for count in cycles)
    if not whole or math.gcd(*cycles) > 1:
        raise ValueError(
            f"cycles are {cycles}; they must be positive whole numbers without a "
            "common factor"
        )
    eased = _eased(time, rise)
    columns = [
        signals.SIGNALS[kind](eased, count * frequency, a, o)
        for kind, count, a, o in zip(
            _quadrature(cycles[0]), cycles, _pair(amplitude), _pair(offset), strict=True
        )
    ]
    return jnp.stack(columns, axis=1)


def raster(
    time: signals.Time,
    frequency: ScalarLike = 10.0,
    amplitude: Pair = 5.0,
    offset: Pair = 0.0,
    lines: int = LINES,
    turnaround: float = 0.1,
    stepped: bool = False,
    rise: float = 0.0,
) -> Path:
    """Return a raster scan: the first axis scans fast, the second slowly up and down.

    ``frequency`` (Hz) is that of the first axis, with two lines per period. Each turn
    takes the share ``turnaround`` of the period (0 for a triangle). The second axis
    covers its range in ``lines`` lines, at constant speed or, with ``stepped``, by one
    line in each turn. Both axes range from ``offset`` to ``offset + 2 amplitude``.
    ``rise`` as for ``circle``. Raises ValueError for fewer than 2 lines or a turnaround
    outside 0 to 0.5.
    """
    if not isinstance(lines, int) or lines < 2:
        raise ValueError(f"lines is {lines!r}; it must be a whole number of 2 or more")
    (a_fast, a_slow), (o_fast, o_slow) = _pair(amplitude), _pair(offset)
    eased = _eased(time, rise)
    fast = signals.scan(eased, frequency, a_fast, o_fast, turnaround)
    if stepped:
        share = _stairs(2.0 * eased * frequency, lines, turnaround)
        slow = o_slow + 2.0 * a_slow * share
    else:
        slow = signals.triangle(eased, frequency / lines, a_slow, o_slow)
    return jnp.stack([fast, slow], axis=1)


def signals_of(name: str) -> tuple[str, str]:
    """Return the names of the two signals of the contour ``name``.

    ``CIRCLE5`` gives SIN5 and COS5. ``LISSAJOUS5/4`` gives SIN5 and COS4, or COS and
    SIN if the figure would otherwise retrace itself. ``RASTER10/0.5`` gives SCAN10 and
    TRI0.5; without the second number the raster has 20 lines. Raises ValueError for
    another name.
    """
    match = re.fullmatch(r"([A-Z]+)(\d*\.?\d+)(?:/(\d*\.?\d+))?", name)
    kind, first, second = match.groups() if match else ("", "1", None)
    if all(float(number) > 0.0 for number in (first, second or "1")):
        if kind == "CIRCLE" and not second:
            return f"SIN{first}", f"COS{first}"
        if kind == "LISSAJOUS" and second:
            ratio = Fraction(first) / Fraction(second)
            waves = _quadrature(ratio.numerator)
            return f"{waves[0]}{first}", f"{waves[1]}{second}"
        if kind == "RASTER":
            # Without an exponent, which the name of a signal cannot hold.
            slow = second or f"{Decimal(str(float(Fraction(first) / LINES))):f}"
            return f"SCAN{first}", f"TRI{slow}"
    raise ValueError(
        f"contour {shown(name)} is unknown; it must have the form of one of "
        f"{', '.join(FORMS)}, with frequencies in Hz above 0"
    )


def _quadrature(first: int) -> tuple[str, str]:
    # The figure cos(p w), sin(q w) with p and q coprime is symmetric about some w, and
    # so retraces itself, if and only if p is even.
    return ("COS", "SIN") if first % 2 == 0 else ("SIN", "COS")


def _pair(value: Pair) -> tuple[ScalarLike, ScalarLike]:
    return value if isinstance(value, tuple) else (value, value)


def _eased(time: signals.Time, rise: float) -> signals.Time:
    """Return a time whose rate rises linearly from 0 to 1 over ``rise`` s."""
    check("rise in s", rise, least=0.0)
    if rise == 0.0:
        return time
    return jnp.where(time < rise, time**2 / (2.0 * rise), time - 0.5 * rise)


def _stairs(line: signals.Time, lines: int, turnaround: float) -> signals.Time:
    """Return stairs from 0 to 1 and back: a step at each whole ``line`` except 0."""
    nearest = jnp.floor(line + 0.5)
    width = max(turnaround, 1e-9)
    along = jnp.clip((line - nearest + width) / (2.0 * width), 0.0, 1.0)
    climbed = jnp.maximum(nearest - 1.0 + along**2 * (3.0 - 2.0 * along), 0.0)
    last = lines - 1
    return 1.0 - jnp.abs(jnp.mod(climbed, 2.0 * last) - last) / last
