"""Signals of a case for tuning and hold-out: references, noise, disturbances."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.arrays import as_array, as_signal
from ..core.feedback import Feedback, holding_input
from ..core.system import System
from ..identification.residual_record import Part
from ..signals import waveforms
from ..study import Case, Stage
from ..study.measured_noise import MeasuredNoise
from .runs import Signals
from .traces import Trace, traces_of
from .unexplained import (
    STRETCHES,
    Suppression,
    leaves_unexplained,
    suppression_of,
    unexplained_disturbances,
)

_STREAMS: dict[Part, int] = {"train": 0, "validate": 1}
"""Random streams of one seed: the hold-out has other draws than tuning."""

PLACES = 8
"""Holding inputs are computed at a multiple of this number of places."""


@dataclass
class Data:
    """Signals of a case for tuning and for the hold-out, with their traces."""

    tuned: int  # number of traces tuned on; they come first
    traces: tuple[Trace, ...]
    tuning: Signals
    holdout: Signals

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the traces."""
        return tuple(trace.name for trace in self.traces)


def make_data(case: Case) -> Data:
    """Return the signals of ``case``, the tuning references before the unseen ones.

    The noise of the hold-out comes from a random stream of its own. If the plant leaves
    something unexplained, both parts have ``STRETCHES`` times as many draws.
    """
    study = case.study
    (holding,) = holding_inputs(own_stage(case.loop), case.references[:, 0])
    tuning, holdout = (_signals(case, part, holding) for part in _STREAMS)
    traces = traces_of(study)
    count = len(study.references.tune)
    tuned = sum(trace.run < count for trace in traces)
    picked = tuple((t.run, t.axis) for t in traces) if study.axes else ()
    first = jax.tree.map(lambda x: x[:count], tuning)
    return Data(
        tuned,
        traces,
        tuning=dataclasses.replace(first, traces=picked[:tuned]),
        holdout=dataclasses.replace(holdout, traces=picked),
    )


def depends_on_loop(case: Case) -> bool:
    """Return whether ``judging`` changes the hold-out: with a residual, on one axis."""
    return case.residual is not None and not case.study.axes


def judging(data: Data, case: Case, loop: Feedback) -> Data:
    """Return ``data`` with the stretches of the residual that harm ``loop`` most.

    Only the hold-out changes. ``data`` is returned as it is without a residual, and on
    several axes.
    """
    study, reference = case.study, case.margin_reference
    if not depends_on_loop(case) or isinstance(reference, tuple):
        return data
    samples = case.references.shape[1]
    worst_for = suppression_of(loop, reference, samples, study.settled, study.dt)
    return dataclasses.replace(
        data, holdout=_signals(case, "validate", data.holdout.holding, worst_for)
    )


def _signals(
    case: Case,
    part: Part,
    holding: jax.Array | None,
    loop: Suppression | None = None,
) -> Signals:
    """Return the signals of all references, with one ``part`` of the records.

    The part "train" is for tuning, "validate" for the hold-out.
    """
    study, references = case.study, case.references
    time_s = waveforms.time_grid(study.references.duration, study.rate)
    stream = np.random.SeedSequence(study.seed).spawn(len(_STREAMS))[_STREAMS[part]]
    random = np.random.default_rng(stream)
    drawn = {"train": study.objective.noise_draws, "validate": study.holdout_draws}
    draws = drawn[part]
    count, samples, *axes = references.shape
    unexplained = leaves_unexplained(case)
    if unexplained:
        draws *= STRETCHES
    shape = (count, draws, samples, *axes)
    noise = _noise(case, random, shape, part)
    disturbance = None
    if unexplained:
        played = unexplained_disturbances(case, np.asarray(time_s), part, loop)
        disturbance = as_array(np.repeat(played, draws // STRETCHES, axis=1))
    drift = np.array(case.study.by_axis(case.study.disturbance.drift_rms))
    if drift.any():
        steps = random.standard_normal(shape) * np.sqrt(case.study.dt)
        # One axis has no dimension for axes.
        walk = as_array(np.cumsum(steps, axis=2) * (drift if axes else drift[0]))
        disturbance = walk if disturbance is None else disturbance + walk
    moved, pushed = (
        None
        if measured is None
        else _measured(measured, random, shape, part, len(axes))
        for measured in (case.output_disturbance, case.input_disturbance)
    )
    if moved is not None:
        disturbance = moved if disturbance is None else disturbance + moved
    return Signals(as_array(references), noise, disturbance, pushed, (), holding)


def _noise(
    case: Case, random: np.random.Generator, shape: tuple[int, ...], part: Part
) -> jax.Array:
    """Return draws of unit variance, white or those of the study's file."""
    measured = case.sensor_noise
    if measured is None:
        return as_array(random.standard_normal(shape))
    rms = measured.rms if len(shape) > 3 else measured.rms[0]
    drawn = _measured(measured, random, shape, part, len(shape) - 3)
    return drawn / np.where(rms > 0.0, rms, 1.0)


def _measured(
    measured: MeasuredNoise,
    random: np.random.Generator,
    shape: tuple[int, ...],
    part: Part,
    axes: int,
) -> jax.Array:
    """Return noise of a file, [references, draws, samples, *axes]."""
    drawn = measured.draws(random, shape[:2], shape[2], part)
    return as_array(drawn if axes else drawn[..., 0])


def own_stage(loop: Feedback) -> Stage:
    """Return the stage of ``loop`` as a stack of one."""
    return jax.tree.map(lambda x: x[None], Stage(loop.plant, loop.sensor))


def held(stages: Stage, begins: Any) -> Stage:
    """Return the stacked ``stages`` with their holding inputs at ``begins``."""
    return dataclasses.replace(stages, holding=holding_inputs(stages, begins))


def holding_inputs(stages: Stage, begins: Any) -> jax.Array:
    """Return the inputs [stages, begins, *axes] under which each stage rests."""
    # Many references begin at the same place: solve once for each place.
    places, which = np.unique(np.asarray(begins), axis=0, return_inverse=True)
    # Pad with copies of the last place: fewer sizes need fewer programs.
    more = [(0, -len(places) % PLACES), *[(0, 0)] * (places.ndim - 1)]
    places = np.pad(places, more, mode="edge")
    found = np.asarray(_holding(stages.plant, as_array(places)))
    return as_array(found[:, which.ravel()])


# Compiled once for all plants of a structure.
@eqx.filter_jit
def _holding(plants: System, places: jax.Array) -> jax.Array:
    dynamic, static = eqx.partition(plants, eqx.is_array)

    def one(part, begin):
        found = holding_input(eqx.combine(part, static), as_signal(begin))
        return jnp.stack(found) if isinstance(found, tuple) else found

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(dynamic, places)
