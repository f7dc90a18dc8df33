"""Comparison of several studies, tuned one after another."""

import time
from collections.abc import Callable, Sequence

import numpy as np
from pydantic import BaseModel

from ..core.progress import Progress, Silent
from ..study import ComparedCase
from ..study.comparison_study import Start
from .outcome import Outcome
from .result import Perturbed, Result, Status
from .tuner import tune

COMPARISON_FILE = "comparison.json"


class TunedStudy(BaseModel):
    """Tuned study of a comparison: geometric means of RMS errors over references, um.

    ``before_um`` and ``after_um`` are those on held-out noise, ``unseen_before_um`` and
    ``unseen_um`` those on held-out references with held-out noise; None where a run
    diverges or stays at a voltage limit. ``perturbed`` holds the figures on the
    held-out plants of an ensemble. ``tuned`` is the number of tuned parameters.
    ``alarms`` are the reasons not to use the gains. A study that could not be tuned has
    the status "failed" and the reason in ``alarms``.
    """

    study: str
    controller: str
    rate_Hz: float  # noqa: N815
    start: Start
    status: Status | str
    before_um: float | None = None
    after_um: float | None = None
    unseen_before_um: float | None = None
    unseen_um: float | None = None
    perturbed: Perturbed | None = None
    tuned: int = 0
    notes: list[str] = []
    alarms: list[str] = []
    wall_s: float = 0.0

    @property
    def ratio(self) -> float | None:
        """Ratio of the errors on held-out noise before and after tuning."""
        return _ratio(self.before_um, self.after_um)

    @property
    def unseen_ratio(self) -> float | None:
        """Ratio of the errors on held-out references before and after tuning."""
        return _ratio(self.unseen_before_um, self.unseen_um)

    @property
    def perturbed_um(self) -> float | None:
        """Error of the tuned gains on the median held-out plant, um.

        None without such plants, or if a run on any of them diverges or stays at a
        voltage limit.
        """
        if self.perturbed is None or self.perturbed.unstable:
            return None
        return self.perturbed.geomean_rms_um


class ComparisonResult(BaseModel):
    """Content of ``comparison.json``: the rows, with summaries by controller and rate.

    ``better`` and ``unseen_better`` are the geometric means of ``ratio`` and
    ``unseen_ratio`` over the rows of a controller, None where one of its runs diverges
    or stays at a voltage limit, or one of its rows failed. ``best`` is the controller
    with the lowest error after tuning at each rate (Hz), ``best_perturbed`` that with
    the lowest error on the median held-out plant.
    """

    title: str
    status: str
    rows: list[TunedStudy]
    better: dict[str, float | None]
    unseen_better: dict[str, float | None]
    best: dict[str, str]
    best_perturbed: dict[str, str] = {}
    versions: dict[str, str]
    seed: int
    wall_s: float


def compare(
    title: str,
    entries: Sequence[ComparedCase],
    *,
    progress: Progress | None = None,
    done: Callable[[Outcome], None] = lambda outcome: None,
) -> ComparisonResult:
    """Tune every entry and return the comparison.

    ``done`` is called with each Outcome. A study without a stable point becomes a row
    with the reason. ``Ctrl-C`` ends the current study, keeps its row, and leaves out
    the remaining studies.
    """
    progress = progress or Silent()
    began = time.perf_counter()
    rows: list[TunedStudy] = []
    versions: dict[str, str] = {}
    status = "complete"
    for number, entry in enumerate(entries, 1):
        progress.stage(f"{number} of {len(entries)}: {entry.case.study.title}")
        try:
            outcome = tune(entry.case, progress=progress)
        except ValueError as error:
            rows.append(_row(entry, "failed", alarms=[str(error)]))
            continue
        rows.append(_row_of(entry, outcome.result))
        versions = outcome.result.versions
        done(outcome)
        if outcome.result.status == "interrupted":
            status = "interrupted"
            break
    return ComparisonResult(
        title=title,
        status=status,
        rows=rows,
        better=_by_controller(rows, "ratio"),
        unseen_better=_by_controller(rows, "unseen_ratio"),
        best=_best(rows, "after_um"),
        best_perturbed=_best(rows, "perturbed_um"),
        versions=versions,
        seed=entries[0].case.study.seed,
        wall_s=time.perf_counter() - began,
    )


def _row(entry: ComparedCase, status: str, **rest) -> TunedStudy:
    return TunedStudy(
        study=entry.name,
        controller=entry.controller,
        rate_Hz=entry.case.study.rate,
        start=entry.start,
        status=status,
        **rest,
    )


def _row_of(entry: ComparedCase, result: Result) -> TunedStudy:
    def geomean(scores):
        return scores.geomean_rms_um if scores is not None and scores.stable else None

    return _row(
        entry,
        result.status,
        before_um=geomean(result.holdout_before),
        after_um=geomean(result.holdout),
        unseen_before_um=geomean(result.unseen_before),
        unseen_um=geomean(result.unseen),
        perturbed=result.perturbed,
        tuned=len(result.gains),
        notes=result.warnings,
        alarms=result.alarms,
        wall_s=result.wall_s,
    )


def _ratio(before: float | None, after: float | None) -> float | None:
    return before / after if before and after else None


def _by_controller(rows: Sequence[TunedStudy], figure: str) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for controller in dict.fromkeys(row.controller for row in rows):
        ratios = [getattr(row, figure) for row in rows if row.controller == controller]
        known = [ratio for ratio in ratios if ratio is not None]
        all_known = len(known) == len(ratios)
        found[controller] = float(np.exp(np.mean(np.log(known)))) if all_known else None
    return found


def _best(rows: Sequence[TunedStudy], figure: str) -> dict[str, str]:
    """Return the controller with the lowest ``figure`` by rate."""
    best: dict[float, tuple[float, str]] = {}
    for row in rows:
        error, rate = getattr(row, figure), row.rate_Hz
        if error is not None and (rate not in best or error < best[rate][0]):
            best[rate] = error, row.controller
    return {f"{rate:g}": best[rate][1] for rate in sorted(best)}
