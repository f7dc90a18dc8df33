"""Figures of other controllers on the hold-out, beside those of the tuned one."""

from typing import Any

import jax
import numpy as np

from ..analysis.constraints import LoopFigures, worst_by_plant
from ..core.feedback import Feedback
from ..core.progress import Progress
from ..study import Case
from .data import Data
from .evaluator import Evaluator
from .objective import RAILED
from .result import Beside

PEAK = "sensitivity_peak"


def figures_beside(
    case: Case, data: Data, evaluator: Evaluator, after: Feedback, progress: Progress
) -> dict[str, Beside]:
    """Return the figures of the controllers that the study names beside its own.

    If it names any, those of its own gains and of ``after`` follow as "before" and
    "tuned".
    """
    if not case.beside:
        return {}
    controllers = {
        **case.beside,
        "before": case.loop.controller,
        "tuned": after.controller,
    }
    driven = np.array([trace.driven for trace in data.traces])
    stages = case.ensemble.stages("holdout") if case.ensemble else None
    found = {}
    for name, controller in controllers.items():
        progress.stage(f"evaluating {name}")
        own = case.loop
        loop = Feedback(controller, own.plant, own.actuator, own.sensor)
        nominal = evaluator.limited(loop, data.holdout)
        plants = nominal
        if stages is not None:
            plants = evaluator.limited(loop, data.holdout, stages, stages)
        (error,), errors = _errors(nominal, driven), _errors(plants, driven)
        peak = np.inf
        if PEAK in case.study.limits:
            peak = float(np.max(worst_by_plant([PEAK], plants)[PEAK]))
        found[name] = Beside(
            nominal_rms_um=_number(error),
            **({} if stages is None else _of_plants(errors)),
            sensitivity_peak=_number(peak),
        )
    return found


def _of_plants(errors: np.ndarray) -> dict[str, Any]:
    return {
        "geomean_rms_um": _number(np.median(errors)),
        "worst_rms_um": _number(np.max(errors)),
        "plants": len(errors),
        "unstable": int(np.sum(~np.isfinite(errors))),
    }


def _errors(figures: LoopFigures, driven: np.ndarray) -> np.ndarray:
    """Return, by plant, the geometric mean over references of the RMS error, um.

    Of several noise draws the worst counts. The mean is infinite where a run diverges,
    or saturates in more than the share ``RAILED`` of its samples.
    """
    tracking = jax.tree.map(np.asarray, figures.tracking)
    rms = np.max(tracking.rms_error, axis=2)[:, driven]
    lost = np.any(tracking.saturated > RAILED, axis=(1, 2)) | ~np.isfinite(rms).all(1)
    with np.errstate(divide="ignore"):
        means = np.exp(np.mean(np.log(np.where(lost[:, None], np.inf, rms)), axis=1))
    return means


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
