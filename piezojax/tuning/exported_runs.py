"""Runs of a study on which its exported controller is tested."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.arrays import as_signal
from ..core.feedback import Feedback
from ..core.system import System, rest_output
from ..exporting.compiled_loop import Runs, RunTrace
from ..exporting.slots import Interface
from ..study import Case
from .data import judging, make_data
from .runs import Signals
from .traces import traces_of


def holdout_of(case: Case, controller: System) -> Signals:
    """Return the hold-out of ``case`` for its loop with ``controller``.

    As in the result of tuning, the residual of the plant acts where it harms that loop
    most.
    """
    loop = dataclasses.replace(case.loop, controller=controller)
    return judging(make_data(case), case, loop).holdout


def make_runs(case: Case, signals: Signals) -> Runs:
    """Return the hold-out ``signals`` of ``case`` as runs of a compiled controller.

    A run is a reference with one draw of the noise.
    """
    loop, study = case.loop, case.study
    count, draws, samples = signals.noise.shape[:3]
    shape = count * draws, samples, study.axis_count

    def flat(signal: jax.Array | None) -> np.ndarray:
        values = np.zeros(()) if signal is None else np.asarray(signal)
        return np.broadcast_to(values, signals.noise.shape).reshape(shape)

    reference = flat(signals.references[:, None])
    following = np.concatenate([reference[:, 1:], reference[:, -1:]], axis=1)
    added = signals.noise, signals.disturbance, signals.input_disturbance
    rests = eqx.filter_jit(_rests)(loop, signals.begins, signals.holding)
    held = {
        key: np.repeat(np.asarray(value).reshape(count, -1), draws, axis=0)
        for key, value in rests.items()
    }
    first = reference[:, 0]
    starts = [first, first, held["reading"], held["voltage"], held["displacement"]]
    voltage, displacement = (
        as_signal(held[key][0] if study.axes else held[key][0, 0])
        for key in ("voltage", "displacement")
    )
    sensed = displacement, jax.tree.map(jnp.zeros_like, displacement)
    return Runs(
        loop.plant,
        loop.sensor,
        Interface(voltage, voltage),
        Interface(sensed, sensed),
        np.concatenate(starts, axis=1),
        np.concatenate([reference, following, *map(flat, added)], axis=2),
        tuple(
            RunTrace(
                each.name,
                each.unit,
                slice(each.run * draws, (each.run + 1) * draws),
                each.axis,
            )
            for each in traces_of(study)
        ),
        study.settled,
    )


def _rests(
    loop: Feedback, begins: jax.Array, holding: jax.Array | None
) -> dict[str, jax.Array]:
    """Return voltage, displacement and reading [runs, *axes] at rest at ``begins``."""

    def one(begin: jax.Array, held: jax.Array | None) -> dict[str, jax.Array]:
        state = loop.init(begin, held)
        quiet = jax.tree.map(jnp.zeros_like, state.displacement)
        reading = rest_output(loop.sensor, (state.displacement, quiet))
        found = (state.voltage, state.displacement, reading)
        names = ("voltage", "displacement", "reading")
        return {
            n: jnp.stack(jax.tree.leaves(x)) for n, x in zip(names, found, strict=True)
        }

    return jax.vmap(one)(begins, holding)
