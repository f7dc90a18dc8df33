"""Comparison of tuning with its baselines: the content of ``baselines.json``."""

from pathlib import Path

import numpy as np
from pydantic import BaseModel

from ...core.files import read_model
from ...solve.history import History
from ...solve.problem import FAILED_LOSS

BASELINES_FILE = "baselines.json"

NEAR = 1e-3
"""Distance from its last loss within which a search counts as finished."""


class BaselineEntry(BaseModel):
    """A method of the comparison: its gains, loss and times.

    ``loss`` is the objective, ``holdout_geomean_um`` the geometric mean of the RMS
    errors on held-out noise; both are None where the loop diverges. ``wall_s`` is the
    duration of the method, ``compile_s`` the part of it spent waiting for the compiler,
    ``cpu_s`` the processor time of all threads, and ``best_s`` the time at which the
    method had come within ``NEAR`` of its ``loss``. ``times_s``, ``compiled_s``,
    ``used_s`` (processor time), ``evaluated`` and ``losses`` are its history. ``unit``
    is the point in the study's box, None for a rule, whose controller is a PID.

    ``reached_s`` is the time at which the search of ``piezojax.tune`` had a loss as
    low, and ``reached_evaluations`` the number of its evaluations then. ``ratio`` is
    ``wall_s`` over ``reached_s``. ``ratio_running`` is the same without compile time,
    ``ratio_best`` with ``best_s`` in place of ``wall_s``, and ``ratio_cpu`` with
    processor times. All are None if the search never had a loss as low.
    """

    method: str
    loss: float | None
    holdout_geomean_um: float | None
    evaluations: int
    wall_s: float
    compile_s: float
    cpu_s: float
    best_s: float
    stop: str
    gains: dict[str, float]
    unit: list[float] | None = None
    times_s: list[float] = []
    compiled_s: list[float] = []
    used_s: list[float] = []
    evaluated: list[int] = []
    losses: list[float] = []
    reached_s: float | None = None
    reached_evaluations: int | None = None
    ratio: float | None = None
    ratio_running: float | None = None
    ratio_best: float | None = None
    ratio_cpu: float | None = None


class Baselines(BaseModel):
    """Content of ``baselines.json``: the search of piezojax and the baselines.

    ``entries`` are in the order in which they were run. ``best`` names the one with
    the lowest loss, None if none has a stable loop. ``notes`` lists the baselines that
    could not be run, with the reasons.
    """

    study: str
    title: str
    seed: int
    aggregate: str
    ours: BaselineEntry
    entries: list[BaselineEntry]
    best: str | None
    notes: list[str]

    def entry(self, method: str) -> BaselineEntry:
        """Return the entry of ``method``. Raises KeyError if there is none."""
        return {entry.method: entry for entry in self.entries}[method]


def load_baselines(path: str | Path) -> Baselines:
    """Return the Baselines in a ``baselines.json``, or in the folder that holds one.

    Raises ValueError if the file is missing or damaged.
    """
    path = Path(path)
    path = path / BASELINES_FILE if path.is_dir() else path
    return read_model(Baselines, path, "holds no baselines")


def baseline_entry(
    method: str,
    history: History,
    stop: str,
    holdout_um: float | None,
    gains: dict[str, float],
    unit: np.ndarray | None,
) -> BaselineEntry:
    """Return the BaselineEntry of a method from its history."""
    near = history.reached(history.loss + NEAR)
    assert near is not None
    return BaselineEntry(
        method=method,
        loss=history.loss if history.loss < FAILED_LOSS else None,
        holdout_geomean_um=holdout_um,
        evaluations=history.evaluations[-1],
        wall_s=history.times_s[-1],
        compile_s=history.compile_s[-1],
        cpu_s=history.cpu_s[-1],
        best_s=history.times_s[near],
        stop=stop,
        gains=gains,
        unit=None if unit is None else [float(x) for x in unit],
        times_s=history.times_s,
        compiled_s=history.compile_s,
        used_s=history.cpu_s,
        evaluated=history.evaluations,
        losses=history.losses,
    )


def with_ratios(entry: BaselineEntry, ours: BaselineEntry) -> BaselineEntry:
    """Return ``entry`` with the time at which ``ours`` reached its loss, and ratios."""
    loss = np.inf if entry.loss is None else entry.loss
    place = next((i for i, own in enumerate(ours.losses) if own <= loss), None)
    if place is None:
        return entry
    reached = ours.times_s[place]
    running = reached - ours.compiled_s[place]
    return entry.model_copy(
        update={
            "reached_s": reached,
            "reached_evaluations": ours.evaluated[place],
            "ratio": entry.wall_s / reached,
            "ratio_running": (entry.wall_s - entry.compile_s) / running,
            "ratio_best": entry.best_s / reached,
            "ratio_cpu": entry.cpu_s / ours.used_s[place],
        }
    )
