"""Named references of several axes, such as ``"Z:SIN1"`` or ``"Z:PWSW2 Ry:SW10"``.

Each word drives one axis with a signal of ``piezojax.signals``, or two axes with a
contour of ``piezojax.signals.contours``, as in ``"Rx+Ry:CIRCLE5"``. The other axes hold
their offset.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.plain import shown
from . import contours
from . import waveforms as signals


def parse(name: str, axes: Sequence[str]) -> dict[str, str]:
    """Return the name of the signal on each driven axis, by axis.

    Raises ValueError for an axis that is not in ``axes``, an axis driven twice, no
    driven axis, or an unknown signal or contour.
    """
    driven: dict[str, str] = {}
    for word in name.split():
        moved, colon, kind = word.partition(":")
        on = moved.split("+")
        if not colon or len(on) > 2 or any(axis not in axes for axis in on):
            raise ValueError(
                f"motion {shown(name)}: {shown(word)} must be an axis, one of "
                f"{', '.join(axes)}, "
                "and a signal, as in Z:SIN10, or two axes and a contour, as in "
                "X+Y:CIRCLE5"
            )
        kinds = (kind,) if len(on) == 1 else contours.signals_of(kind)
        for axis, each in zip(on, kinds, strict=True):
            if axis in driven:
                raise ValueError(f"motion {shown(name)} drives {axis} twice")
            signals.parse(each)
            driven[axis] = each
    if not driven:
        raise ValueError(f"motion {shown(name)} drives no axis")
    return driven


def contour_axes(name: str, axes: Sequence[str]) -> tuple[int, int] | None:
    """Return the indices in ``axes`` of the first contour of a motion, or None.

    Raises ValueError as ``parse``.
    """
    parse(name, axes)
    for word in name.split():
        on = word.partition(":")[0].split("+")
        if len(on) == 2:
            return axes.index(on[0]), axes.index(on[1])
    return None


def motion(
    name: str,
    time: signals.Time,
    axes: Sequence[str],
    amplitudes: Sequence[float],
    offsets: Sequence[float],
) -> Float[Array, "samples axes"]:
    """Return the motion called ``name`` on ``time``, a column for each of ``axes``.

    ``amplitudes`` and ``offsets`` in the unit of each axis. Raises ValueError as
    ``parse``.
    """
    driven = parse(name, axes)
    columns = [
        signals.signal(driven[axis], time, amplitude, offset)
        if axis in driven
        else jnp.full_like(time, offset)
        for axis, amplitude, offset in zip(axes, amplitudes, offsets, strict=True)
    ]
    return jnp.stack(columns, axis=1)
