"""References of several axes by name: ``"Z:SIN1"``, ``"Z:PWSW2 Ry:SW10"``.

Each word drives one axis with a signal of ``piezojax.signals``; all others hold their
offset.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from . import signals


def parse(name: str, axes: Sequence[str]) -> dict[str, str]:
    """Return the signal on each driven axis, by the axis.

    Raises ValueError for an axis that is not among ``axes``, one driven twice, none
    driven, or an unknown signal.
    """
    driven: dict[str, str] = {}
    for word in name.split():
        axis, colon, kind = word.partition(":")
        if not colon or axis not in axes:
            raise ValueError(
                f"motion {name!r}: {word!r} must be an axis, one of {', '.join(axes)}, "
                "and a signal, as in Z:SIN10"
            )
        if axis in driven:
            raise ValueError(f"motion {name!r} drives {axis} twice")
        signals.parse(kind)
        driven[axis] = kind
    if not driven:
        raise ValueError(f"motion {name!r} drives no axis")
    return driven


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
