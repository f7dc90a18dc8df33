"""Objective of a case: signals, scales of the errors, and the stages drawn."""

import jax
import numpy as np

from ..core.arrays import as_array
from ..core.metrics import TrackingFigures
from ..study import Case
from .data import Data, held
from .evaluator import Evaluator, drawn_stages
from .objective import RAILED, Objective


def make_objective(
    case: Case, data: Data, evaluator: Evaluator, before: TrackingFigures
) -> Objective:
    """Return the objective of ``case`` on its tuning signals, without limits.

    ``before`` are the figures of the study's own gains; they scale the errors.
    """
    table = case.study
    stages = drawn_stages(case, "tune")
    if stages is not None:
        stages = held(stages, data.tuning.begins)
    before = jax.tree.map(np.asarray, before)
    scale = _scale(before, data)[None]
    if stages is not None:
        found = jax.tree.map(
            np.asarray, evaluator.figures_on(stages, case.loop, data.tuning)
        )
        parts = (jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(found[0])))
        scale = np.stack([_scale(one, data, scale[0]) for one in parts])
    return Objective(
        loop=case.loop,
        space=case.space,
        signals=data.tuning,
        scale=as_array(scale),
        voltage_span=as_array(
            np.mean(np.subtract(table.actuator.upper, table.actuator.lower))
        ),
        start=evaluator.start,
        aggregate=table.objective.aggregate,
        effort_weight=table.objective.effort_weight,
        slew_weight=table.objective.slew_weight,
        weights=_weights(case, data),
        resting=tuple(not trace.driven for trace in data.traces[: data.tuned]),
        stages=stages,
        margin_stages=evaluator.margin_stages,
        model_error=evaluator.model_error,
        over=table.ensemble.aggregate if table.ensemble else "mean",
        tail=table.ensemble.tail if table.ensemble else 1.0,
        margin_reference=as_array(case.margin_reference),
        margin_duration=case.margin_duration,
        step_test=evaluator.step_test,
        dt=table.dt,
    )


def _scale(
    before: TrackingFigures, data: Data, otherwise: np.ndarray | None = None
) -> np.ndarray:
    """Return the scale (um) of the error of each trace: its RMS error before tuning.

    If the start diverges or stays at a voltage limit, the scale is ``otherwise``, or,
    without it, the standard deviation of the reference.
    """
    rms = np.sqrt(np.mean(before.rms_error**2, axis=1))
    if np.all(np.isfinite(rms)) and np.max(before.saturated) <= RAILED:
        return np.where(rms > 0.0, rms, 1e-9)
    return _swing(data) if otherwise is None else otherwise


def _swing(data: Data) -> np.ndarray:
    swing = np.maximum(np.std(data.tuning.references, axis=1), 1e-3)
    if swing.ndim == 1:
        return swing
    largest = np.max(swing, axis=1)
    return np.stack(
        [
            swing[trace.run, trace.axis] if trace.driven else largest[trace.run]
            for trace in data.traces[: data.tuned]
        ]
    )


def _weights(case: Case, data: Data) -> jax.Array | None:
    """Return the weights of the traces: the coupling weight for axes that should rest.

    None for one axis.
    """
    if case.study.axes is None:
        return None
    coupling = case.study.objective.coupling_weight
    tuned = data.traces[: data.tuned]
    return as_array([1.0 if trace.driven else coupling for trace in tuned])
