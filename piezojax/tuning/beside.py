"""Figures of other controllers on the hold-out, beside those of the tuned one."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..analysis.constraints import LoopFigures, worst_by_plant
from ..core.progress import Progress
from ..solve.multi_start import in_threads
from ..study import Case
from .alarms import PEAK
from .data import Data
from .held_out import HeldOut
from .result import Beside, log_errors, number


def figures_beside(
    case: Case, data: Data, loops: Mapping[str, HeldOut], progress: Progress
) -> dict[str, Beside]:
    """Return the figures of the controllers that the study names beside its own.

    If it names any, the figures of ``loops`` follow, those of ``held_out_loops``.
    """
    if not case.beside:
        return {}
    driven = np.array([trace.driven for trace in data.traces])
    own = loops["before"]
    others = {
        name: replace(own, loop=replace(own.loop, controller=controller))
        for name, controller in case.beside.items()
    }
    every = others | dict(loops)
    progress.stage("evaluating the other controllers")
    found = in_threads(
        lambda held_out: _figures(held_out, case, driven), every.values()
    )
    return dict(zip(every, found, strict=True))


def _figures(held_out: HeldOut, case: Case, driven: np.ndarray) -> Beside:
    (error,) = _errors(held_out.nominal, driven)
    plants = held_out.perturbed
    peak = np.inf
    if PEAK in case.study.limits:
        peak = np.max(worst_by_plant([PEAK], plants or held_out.nominal)[PEAK])
    return Beside(
        nominal_rms_um=number(error),
        **({} if plants is None else _of_plants(_errors(plants, driven))),
        sensitivity_peak=number(peak),
    )


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
