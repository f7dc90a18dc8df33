"""The P-558.TCD as the plant of a loop: hysteresis, then the printed dynamics.

No hysteresis of this stage is printed. A play operator of 2 % represents the residual
hysteresis of its internal loop: an assumption of ours, consistent with the errors of
the driven axes in Table 7-4.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.axes import PerAxis
from ..core.system import Delay, Series, System, series
from ..dynamics import Channel, Channels, channels_of
from ..hysteresis import PrandtlIshlinskii
from . import p558
from .p558 import OUTPUTS

HYSTERESIS = 0.02
"""Share of the stroke that passes through the play operator."""

Deviations = Float[Array, " axes"] | tuple[float, ...]

PLAY = 4.0
"""Half-width of the play in um, urad, urad."""


NOMINAL = (0.0, 0.0, 0.0)
"""No deviation of any axis."""


def plant(
    gain: Deviations = NOMINAL,
    speed: Deviations = NOMINAL,
    hysteresis: Deviations = NOMINAL,
    coupling: Deviations = NOMINAL,
    *,
    delay: int = 0,
) -> Series:
    """Return the stage: hysteresis of each axis, then the dynamics of (7.53).

    Relative deviations by axis: ``gain`` of the channel; ``speed`` of its poles and
    zeros (A becomes I + (1 + speed)(A - I) and B (1 + speed) B, at the same DC gain);
    ``hysteresis``, the share of play; ``coupling``, the gain to the other axes.
    ``delay`` in samples lies between hysteresis and dynamics and adds to the one sample
    of every model. Raises ValueError for a negative delay.
    """
    channels: list[Channel] = []
    for axis, part in enumerate(channels_of(p558.channels("7")).parts):
        faster, gain_of = 1.0 + speed[axis], 1.0 + gain[axis]
        A = tuple(
            tuple(
                float(i == j) + faster * (a - float(i == j)) for j, a in enumerate(row)
            )
            for i, row in enumerate(part.A)
        )
        C = tuple(
            tuple((1.0 + coupling[axis] * (output != axis)) * c for c in row)
            for output, row in enumerate(part.C)
        )
        B = tuple(faster * gain_of * b for b in part.B)
        channels.append(Channel(A, B, C, part.dt))
    loops = tuple(_play(HYSTERESIS * (1.0 + h)) for h in hysteresis)
    parts: dict[str, System] = {"hysteresis": PerAxis(loops, OUTPUTS)}
    if delay:
        parts["delay"] = PerAxis((Delay(delay),) * len(OUTPUTS), OUTPUTS)
    return series(**parts, dynamics=Channels(tuple(channels)))


def _play(share: float | jax.Array) -> PrandtlIshlinskii:
    share = jnp.asarray(share, jnp.float64)
    return PrandtlIshlinskii((1.0 - share,), (PLAY,), (share,))
