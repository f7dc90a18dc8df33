"""Error of the tip of a stage whose sensor may lag behind it."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..core.feedback import Feedback, loop_inputs
from ..core.rollout import simulate
from ..dynamics.lags import before_lag, lags_of
from ..study import Case
from .data import Data
from .runs import Signals

CERTAIN = 1.2
"""Ratio of the error of the tip to that of the reading up to which no note is given."""


def tip_note(case: Case, loop: Feedback, data: Data, start: int) -> str | None:
    """Return a note on the error of the tip in the hold-out, or None if it needs none.

    A record does not tell whether a lag of its fitted plant belongs to the stage or to
    its sensor. If it belongs to the sensor, the loop controls the reading of the
    sensor, and the tip leads that reading. Samples before ``start`` do not count.
    """
    dt = case.study.dt
    lags = [lag for lag in lags_of(case.loop.plant) if lag > dt]
    if case.residual is None or not lags:
        return None
    signals = data.holdout
    reading = np.asarray(_displacements(loop, signals))
    moved = np.zeros_like(reading)
    if signals.disturbance is not None:
        moved[..., 1:] = signals.disturbance[..., :-1]
    tip = reading - moved
    for lag in lags:
        tip = before_lag(tip, lag, dt)
    kept = slice(start, tip.shape[-1])
    wanted = np.asarray(signals.references)[:, None, kept]
    of_reading = _geometric_mean(reading[..., kept] - wanted)
    of_tip = _geometric_mean(tip[..., start:] + moved[..., kept] - wanted)
    if not of_tip > CERTAIN * of_reading:
        return None
    shown = " and ".join(f"{1e3 * lag:.3g} ms" for lag in lags)
    return (
        f"the fitted plant lags by {shown}: if that is the sensor, the loop controls "
        f"its reading, and the error of the tip is {1e3 * of_tip:.4g} nm in the "
        f"hold-out (geometric mean; that of the reading is {1e3 * of_reading:.4g} nm): "
        "to control the tip, filter the reference by the same lag"
    )


def _geometric_mean(errors: Float[np.ndarray, "references draws samples"]) -> float:
    worst = np.max(np.sqrt(np.mean(errors**2, axis=2)), axis=1)
    return float(np.exp(np.mean(np.log(worst))))


@eqx.filter_jit
def _displacements(
    loop: Feedback, signals: Signals
) -> Float[Array, "references draws samples"]:
    def one(reference, run_noise):
        inputs = loop_inputs(reference, *run_noise)
        return simulate(loop, inputs, loop.init(reference[0]))[1].displacement

    draws = jax.vmap(one, in_axes=(None, 0))
    return jax.vmap(draws)(signals.references, signals.run_noise)
