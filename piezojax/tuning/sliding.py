"""Share of the tracking error in the sliding variable, before and after tuning."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array
from pydantic import BaseModel

from ..analysis.sliding_share import sliding_mode_of, sliding_parts
from ..core.feedback import Feedback, loop_inputs
from .data import Data
from .runs import Signals


class SlidingShare(BaseModel):
    """Parts of the sliding variable of a loop, means over the tuning references.

    ``share``, from 0 to 1, is the mean square of the error terms m e + de/dt over the
    sum of the mean squares of the error terms and of the rest. The RMS values of s, of
    the error terms and of the rest are in um/s. The rest is the lag of the observer
    behind the reference, and noise. All values are those under held-out noise, None for
    a loop that diverges.
    """

    share: float | None
    sliding_um_per_s: float | None
    error_um_per_s: float | None
    rest_um_per_s: float | None


def sliding_share(loop: Feedback, data: Data, first: int) -> SlidingShare | None:
    """Return the SlidingShare of ``loop`` on the tuning references of the hold-out.

    Samples before ``first`` do not count. None for a controller without a sliding
    variable m e + de/dt.
    """
    if sliding_mode_of(loop) is None:
        return None
    signals = data.holdout
    values = _parts(loop, jax.tree.map(lambda x: x[: data.tuned], signals), first)
    return SlidingShare(
        **dict(zip(SlidingShare.model_fields, map(_mean, values), strict=True))
    )


def _mean(values: Any) -> float | None:
    mean = float(np.mean(np.asarray(values)))
    return mean if np.isfinite(mean) else None


@eqx.filter_jit
def _parts(loop: Feedback, signals: Signals, first: int) -> tuple[Array, ...]:
    """Return the share and the SlidingParts [references] of ``loop``."""

    def one(reference, run_noise):
        inputs = loop_inputs(reference, *run_noise)
        parts = sliding_parts(loop, inputs, reference[0], first)
        return (parts.share, *parts)

    first_draw = signals.run_noise.of(slice(None), 0)
    return jax.vmap(one)(signals.references, first_draw)
