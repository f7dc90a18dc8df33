"""Figures of other controllers on the hold-out, beside those of the tuned one."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from threading import Event
from typing import Any

import numpy as np

from ..analysis.constraints import LoopFigures, worst_by_plant
from ..core.progress import Progress
from ..study import Case
from .alarms import PEAK
from .data import Data
from .held_out import HeldOut
from .result import Beside, log_errors, number


class FiguresBeside:
    """Figures of the controllers that a study names beside its own, on the hold-out.

    A thread computes them beside other work from ``begin`` on, until the context ends.
    """

    def __init__(self, case: Case):
        self._case, self._stopped = case, Event()
        self._pool = ThreadPoolExecutor(1)
        self._found: Future[dict[str, Beside]] | None = None

    def __enter__(self) -> "FiguresBeside":
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._pool.shutdown(wait=False)

    def begin(self, data: Data, own: HeldOut) -> None:
        """Begin to compute the figures, with those of ``own``, the loop of the study.

        Does nothing if they have begun, or if the study names no controller.
        """
        if not self._case.beside or self._found is not None:
            return
        self._driven = np.array([trace.driven for trace in data.traces])
        # The result needs the figures of the study's own loop first.
        loops = {"before": own}
        for name, controller in self._case.beside.items():
            loops[name] = own.with_loop(replace(own.loop, controller=controller))
        self._found = self._pool.submit(self._compute, loops)

    def _compute(self, loops: dict[str, HeldOut]) -> dict[str, Beside]:
        found = {}
        for name, loop in loops.items():
            if self._stopped.is_set():
                break
            found[name] = self._figures(loop)
        return found

    def all(self, tuned: HeldOut, progress: Progress) -> dict[str, Beside]:
        """Return the figures of all controllers, of the start and of the tuned loop.

        There are none without ``begin``.
        """
        if self._found is None:
            return {}
        progress.stage("evaluating the other controllers")
        last = self._figures(tuned)
        found = self._found.result()
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

    It is infinite where a run diverges or stays at a voltage limit.
    """
    logarithms, lost = log_errors(figures.tracking)
    means = np.exp(np.mean(logarithms[:, driven], axis=1))
    return np.where(lost, np.inf, means)
