"""What a contest of baselines comes to: ``baselines.json``, written and read."""

from pathlib import Path

import numpy as np
from pydantic import BaseModel

from ...core.files import read_model
from ...solve.history import History
from ...solve.problem import HOPELESS

BASELINES_FILE = "baselines.json"

NEAR = 1e-3
"""A search that is no further from its last loss than this has all but ended."""


class Contestant(BaseModel):
    """A method, what it found, and how long that took.

    ``loss`` is the objective, ``holdout_geomean_um`` the geometric mean of the rms
    errors on noise that no method has seen, None where the loop diverges. ``wall_s``
    is from the method's begin to its end, ``compile_s`` the part of it spent waiting
    for the compiler, ``cpu_s`` the processor's seconds of all threads, ``best_s`` when
    it had come within ``NEAR`` of its ``loss``. ``times_s``, ``compiled_s``, ``used_s``
    (of the processor), ``evaluated`` and ``losses`` are its history; ``unit`` is the
    point in the study's box, None for a rule, whose controller is a PID.

    ``reached_s`` is the time at which the search of ``piezojax.tune`` had a loss as
    low, ``ratio`` is ``wall_s`` over it, ``ratio_running`` the same without compiling,
    ``ratio_best`` with ``best_s`` for ``wall_s``, ``ratio_cpu`` the same in processor's
    seconds; None if it never had.
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
    """``baselines.json``: the search of piezojax and its rivals, in the order run.

    ``best`` names the rival with the lowest loss, None if none has a stable loop;
    ``notes`` says what could not be run.
    """

    study: str
    title: str
    seed: int
    aggregate: str
    ours: Contestant
    rivals: list[Contestant]
    best: str | None
    notes: list[str]

    def rival(self, method: str) -> Contestant:
        """Return the rival of that name. Raises KeyError if there is none."""
        return {rival.method: rival for rival in self.rivals}[method]


def load_baselines(path: str | Path) -> Baselines:
    """Read a ``baselines.json``, or the folder that holds one.

    Raises ValueError if there is none or it is damaged.
    """
    path = Path(path)
    path = path / BASELINES_FILE if path.is_dir() else path
    return read_model(Baselines, path, "holds no baselines")


def contestant(
    method: str,
    history: History,
    stop: str,
    holdout_um: float | None,
    gains: dict[str, float],
    unit: np.ndarray | None,
) -> Contestant:
    """Return a method's entry from its history."""
    near = history.reached(history.loss + NEAR)
    assert near is not None
    return Contestant(
        method=method,
        loss=history.loss if history.loss < HOPELESS else None,
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


def against(rival: Contestant, ours: Contestant) -> Contestant:
    """Return ``rival`` with when ``ours`` was as good, and how much sooner."""
    loss = np.inf if rival.loss is None else rival.loss
    place = next((i for i, own in enumerate(ours.losses) if own <= loss), None)
    if place is None:
        return rival
    reached = ours.times_s[place]
    running = reached - ours.compiled_s[place]
    return rival.model_copy(
        update={
            "reached_s": reached,
            "reached_evaluations": ours.evaluated[place],
            "ratio": rival.wall_s / reached,
            "ratio_running": (rival.wall_s - rival.compile_s) / running,
            "ratio_best": rival.best_s / reached,
            "ratio_cpu": rival.cpu_s / ours.used_s[place],
        }
    )
