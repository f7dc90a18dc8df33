"""Comparison of the baselines with the search on one objective, in one process."""

import equinox as eqx
import numpy as np

from ...core.arrays import as_array
from ...core.feedback import Feedback
from ...core.progress import Progress
from ...solve.search_state import SearchState
from ...study import Case
from ..data import Data
from ..objective import Objective
from ..result import scores
from ..runs import evaluate
from .entries import BaselineEntry, Baselines, baseline_entry, with_ratios
from .pids import rule_pids
from .searches import Budget, Method, cma_es, nelder_mead

LARGER = 2
"""Ratio of the second population of CMA-ES to the default one."""


def methods(seed: int, size: int) -> dict[str, Method]:
    """Return the searches without gradients by name, for ``size`` parameters."""
    larger = LARGER * (4 + int(3.0 * np.log(size)))
    return {
        "CMA-ES": cma_es(seed=seed + 1),
        f"CMA-ES, population {larger}": cma_es(larger, seed + 1),
        "Nelder-Mead": nelder_mead,
    }


def compare_baselines(
    objective: Objective,
    case: Case,
    data: Data,
    search: SearchState,
    budget: Budget,
    progress: Progress,
) -> Baselines:
    """Run every baseline on the objective of ``search`` and return the comparison.

    The baselines' searches have the same starts and the same box as ``search``.
    ``Ctrl-C`` ends the comparison and keeps the methods that have finished.
    """

    def entry_of(name, history, stop, unit):
        place = as_array(unit)
        loop = case.space.put(case.loop, place)
        gains = {path: float(x) for path, x in case.space.named(place).items()}
        held = holdout_geomean(loop, data, objective.start)
        return baseline_entry(name, history, stop, held, gains, unit)

    name = f"piezojax ({case.study.optimiser.method})"
    ours = entry_of(name, search.history, search.status, search.unit)
    entries: list[BaselineEntry] = []
    notes: list[str] = []
    try:
        progress.stage("baselines: ultimate gain and relay")
        found, skipped = rule_pids(objective, case)
        notes += skipped
        for name, history, loop, gains in found:
            held = holdout_geomean(loop, data, objective.start)
            entries.append(baseline_entry(name, history, "rule", held, gains, None))
        size = len(case.space.paths)
        for name, method in methods(case.study.seed, size).items():
            progress.stage(f"baseline: {name}")
            end = method(objective, search.starts, budget, progress)
            entries.append(entry_of(name, end.history, end.stop, end.unit))
    except KeyboardInterrupt:
        notes.append("interrupted: baselines after the last one shown were not run")
    stable = {r.method: r.loss for r in entries if r.loss is not None}
    return Baselines(
        study=case.name,
        title=case.study.title,
        seed=case.study.seed,
        aggregate=case.study.objective.aggregate,
        ours=ours,
        entries=[with_ratios(entry, ours) for entry in entries],
        best=min(stable, key=lambda name: stable[name], default=None),
        notes=notes,
    )


@eqx.filter_jit
def _figures(loop, signals, start):
    return evaluate(lambda x: x, loop, signals, start)


def holdout_geomean(loop: Feedback, data: Data, start: int) -> float | None:
    """Return the geometric mean of the RMS errors on the tuning references, um.

    The noise is that of the hold-out, and the axes are the driven ones. None if the
    loop diverges or stays at a voltage limit.
    """
    figures = _figures(loop, data.holdout, start)
    chosen = [i for i, t in enumerate(data.traces[: data.tuned]) if t.driven]
    part = eqx.tree_at(
        lambda f: tuple(f), figures, tuple(np.asarray(x)[chosen] for x in figures)
    )
    found = scores(part, tuple(data.names[i] for i in chosen))
    return found.geomean_rms_um if found.stable else None
