"""Figures of other controllers on the hold-out, beside those of the tuned one."""

import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from ..analysis.constraints import worst_by_plant
from ..analysis.loop_figures import LoopFigures
from ..core.progress import Progress
from ..study import Case
from .alarms import PEAK
from .data import Data, depends_on_loop
from .held_out import HeldOut
from .result import Beside, log_errors, number


class FiguresBeside:
    """Figures of the controllers that a study names beside its own, on the hold-out.

    They are computed from ``begin`` on, until the context ends: in one thread beside
    the search, or in several after it if the hold-out depends on the tuned loop.
    """

    def __init__(self, case: Case):
        threads = os.cpu_count() if depends_on_loop(case) else 1
        self._case, self._pool = case, ThreadPoolExecutor(threads)
        self._found: dict[str, Future[Beside]] = {}

    def __enter__(self) -> "FiguresBeside":
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)

    def begin(self, data: Data, own: HeldOut) -> None:
        """Begin to compute the figures, with those of ``own``, the loop of the study.

        Does nothing if they have begun, or if the study names no controller.
        """
        if not self._case.beside or self._found:
            return
        self._driven = np.array([trace.driven for trace in data.traces])
        # The result needs the figures of the study's own loop first.
        loops = {"before": own}
        for name, controller in self._case.beside.items():
            loops[name] = own.with_loop(replace(own.loop, controller=controller))
        for name, loop in loops.items():
            self._found[name] = self._pool.submit(self._figures, loop)

    def all(self, tuned: HeldOut, progress: Progress) -> dict[str, Beside]:
        """Return the figures of all controllers, of the start and of the tuned loop.

        The result is empty without ``begin``.
        """
        if not self._found:
            return {}
        progress.stage("evaluating the other controllers")
        last = self._figures(tuned)
        found = {name: figures.result() for name, figures in self._found.items()}
        return found | {"before": found.pop("before"), "tuned": last}

    def _figures(self, held_out: HeldOut) -> Beside:
        (error,) = _errors(held_out.nominal, self._driven)
        plants = held_out.perturbed
        peak = np.inf
        if PEAK in self._case.study.limits:
            peak = np.max(worst_by_plant([PEAK], plants or held_out.nominal)[PEAK])
        return Beside(
            nominal_rms_um=number(error),
            **({} if plants is None else _of_plants(_errors(plants, self._driven))),
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

    It is infinite where the loop is unstable or a run diverges or stays at a voltage
    limit.
    """
    logarithms, lost = log_errors(figures)
    means = np.exp(np.mean(logarithms[:, driven], axis=1))
    return np.where(lost, np.inf, means)
