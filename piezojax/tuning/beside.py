"""Figures of other controllers on the hold-out, beside those of the tuned one."""

from typing import Any

import numpy as np

from ..analysis.constraints import LoopFigures, worst_by_plant
from ..core.feedback import Feedback
from ..core.progress import Progress
from ..study import Case
from .alarms import PEAK
from .data import Data
from .evaluator import Evaluator
from .result import Beside, log_errors, number


def figures_beside(
    case: Case, data: Data, evaluator: Evaluator, after: Feedback, progress: Progress
) -> dict[str, Beside]:
    """Return the figures of the controllers that the study names beside its own.

    If it names any, the figures of its own gains and of ``after`` follow under the keys
    "before" and "tuned".
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
            nominal_rms_um=number(error),
            **({} if stages is None else _of_plants(errors)),
            sensitivity_peak=number(peak),
        )
    return found


def _of_plants(errors: np.ndarray) -> dict[str, Any]:
    return {
        "geomean_rms_um": number(np.median(errors)),
        "worst_rms_um": number(np.max(errors)),
        "plants": len(errors),
        "unstable": int(np.sum(~np.isfinite(errors))),
    }


def _errors(figures: LoopFigures, driven: np.ndarray) -> np.ndarray:
    """Return, by plant, the geometric mean over references of the RMS error, um.

    It is infinite where a run diverges or stays at a voltage limit.
    """
    logarithms, lost = log_errors(figures.tracking)
    means = np.exp(np.mean(logarithms[:, driven], axis=1))
    return np.where(lost, np.inf, means)
