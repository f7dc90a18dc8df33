"""Tuning: screen the box, descend from the best starts, judge on what was held out."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from .. import __version__
from .. import signals as signal_library
from .._types import as_array
from ..metrics import TrackingFigures
from ..progress import Progress, Silent
from ..study import Case, read, shipped
from ..system import Feedback
from .objective import Objective, Signals, evaluate
from .result import Result, Scores, scores
from .search import Clock, Search, search_box


@dataclass
class Outcome:
    """A Result with the loops and signals behind it, for pictures and further use."""

    result: Result
    before: Feedback
    after: Feedback
    case: Case
    holdout: Signals

    @property
    def controller(self):
        """The tuned controller."""
        return self.after.controller


class _Judge:
    """Simulates a loop on signals; compiled once for each shape of them."""

    def __init__(self, clock: Clock, start: int):
        self._clock, self._start = clock, start
        self._programs: dict[tuple[int, ...], Callable] = {}

    def figures(self, loop: Feedback, signals: Signals) -> TrackingFigures:
        """Return the figures by reference and draw."""
        shape = signals.noise.shape
        if shape not in self._programs:
            self._programs[shape] = self._clock.compiled(
                lambda loop, signals: evaluate(lambda x: x, loop, signals, self._start),
                loop,
                signals,
            )
        return self._programs[shape](loop, signals)

    def __call__(
        self, loop: Feedback, signals: Signals, names: tuple[str, ...]
    ) -> Scores:
        """Return the scores by reference."""
        return scores(self.figures(loop, signals), names)


@dataclass
class _Data:
    names: tuple[str, ...]
    tuned: int  # the first so many references are tuned on
    tuning: Signals
    holdout: Signals


def _make_data(case: Case) -> _Data:
    study = case.study
    table = study.references
    time_s = signal_library.time_grid(table.duration, study.rate)
    names = (*table.tune, *table.unseen)
    references = jnp.stack(
        [
            signal_library.signal(name, time_s, table.amplitude, table.offset)
            for name in names
        ]
    )
    # Two streams of one seed: the hold-out draws are new for every reference.
    streams = np.random.SeedSequence(study.seed).spawn(2)
    draws = [
        as_array(
            np.random.default_rng(stream).standard_normal(
                (len(names), count, time_s.size)
            )
        )
        for stream, count in zip(
            streams, (study.objective.noise_draws, study.holdout_draws), strict=True
        )
    ]
    count = len(table.tune)
    return _Data(
        names,
        count,
        tuning=Signals(
            references[:count], draws[0][:count], _unexplained(case, time_s, "train")
        ),
        holdout=Signals(references, draws[1], _unexplained(case, time_s, "validate")),
    )


def _unexplained(
    case: Case, time_s: jax.Array, part: Literal["train", "validate"]
) -> jax.Array | None:
    """Return what the fitted plant leaves unexplained of its record, as a disturbance.

    A controller that contains the fitted model would otherwise be tuned and judged as
    if the stage were that model. Run forth and back to last as long as the references.
    """
    if case.fit is None:
        return None
    fit = case.fit
    where = getattr(fit, part)
    # The first half of the training part holds the initial loading, a single event.
    start = where.start if part == "validate" else (where.start + where.stop) // 2
    residual = (fit.record.output - fit.simulated)[start : where.stop]
    there_and_back = np.concatenate([residual, residual[-2:0:-1]])
    dt = fit.record.dt
    return as_array(
        np.interp(
            np.asarray(time_s),
            np.arange(there_and_back.size) * dt,
            there_and_back,
            period=there_and_back.size * dt,
        )
    )


def tune(
    study: Case | str | Path | None = None, *, progress: Progress | None = None
) -> Outcome:
    """Tune the controller of a study and judge it on held-out noise and references.

    ``study`` is a Case, the path of a study file, or None for the default study.
    ``Ctrl-C`` ends the search and keeps the best gains found so far. A start that
    diverges is replaced by the best of the candidates. Raises ValueError when no point
    of the box, the start included, gives a stable loop.
    """
    progress = progress or Silent()
    clock = Clock()
    case = study if isinstance(study, Case) else read(study or shipped())
    table, space = case.study, case.space
    data = _make_data(case)
    first = round(table.references.settle * table.rate)

    progress.stage("simulating the start")
    judge = _Judge(clock, first)
    before = judge(case.loop, data.tuning, data.names[: data.tuned])
    objective = Objective(
        loop=case.loop,
        space=space,
        signals=data.tuning,
        scale=_scale(before, data.tuning.references),
        voltage_span=as_array(table.actuator.upper - table.actuator.lower),
        start=first,
        aggregate=table.objective.aggregate,
        effort_weight=table.objective.effort_weight,
        slew_weight=table.objective.slew_weight,
    )
    search = search_box(objective, case, clock, progress)

    after = space.put(case.loop, as_array(search.unit))
    try:
        progress.stage("judging on held-out noise")
        result = _report(case, data, judge, before, after, search, clock)
    except KeyboardInterrupt:
        # What was found is kept; only a second interrupt ends this too.
        search.status = "interrupted"
        result = _report(case, data, judge, before, after, search, clock)
    return Outcome(result, case.loop, after, case, data.holdout)


def _scale(before: Scores, references: jax.Array) -> jax.Array:
    # Where the start diverges its error is no measure; the reference's own swing is.
    swing = jnp.maximum(jnp.std(references, axis=1), 1e-3)
    if not before.stable:
        return swing
    return as_array([rms or 1e-9 for rms in before.per_reference_rms_um.values()])


def _report(
    case: Case,
    data: _Data,
    judge: _Judge,
    before: Scores,
    after: Feedback,
    search: Search,
    clock: Clock,
) -> Result:
    tuned, unseen = data.names[: data.tuned], data.names[data.tuned :]

    def held(loop: Feedback) -> tuple[Scores, Scores | None]:
        figures = judge.figures(loop, data.holdout)
        head = jax.tree.map(lambda x: x[: data.tuned], figures)
        tail = jax.tree.map(lambda x: x[data.tuned :], figures)
        return scores(head, tuned), scores(tail, unseen) if unseen else None

    holdout_before, unseen_before = held(case.loop)
    holdout, unseen_after = held(after)
    after_scores = judge(after, data.tuning, tuned)
    unit = np.asarray(search.unit)
    values = case.space.from_unit(as_array(unit))
    at_bound = [
        path
        for path, place in zip(case.space.paths, unit, strict=True)
        if place < 1e-2 or place > 1.0 - 1e-2
    ]
    return Result(
        study=case.name,
        title=case.study.title,
        status=search.status,
        method=case.study.optimiser.method,
        gains=_named(case, values),
        start=_named(case, case.space.from_unit(case.space.start(case.loop))),
        at_bound=at_bound,
        before=before,
        after=after_scores,
        holdout_before=holdout_before,
        holdout=holdout,
        unseen_before=unseen_before,
        unseen=unseen_after,
        warnings=[*search.warnings, *_warnings(case, at_bound, after_scores, holdout)],
        history=search.history,
        evaluations=search.evaluations,
        compile_s=clock.compile_s,
        wall_s=clock.wall_s(),
        versions={"piezojax": __version__} | {n: version(n) for n in _VERSIONED},
        seed=case.study.seed,
    )


_VERSIONED = ("jax", "jaxlib", "optimistix", "jaxopt", "equinox", "numpy")


def _named(case: Case, values: jax.Array) -> dict[str, float]:
    return dict(zip(case.space.paths, map(float, values), strict=True))


def _warnings(
    case: Case, at_bound: list[str], after: Scores, holdout: Scores
) -> list[str]:
    found = []
    if case.fit is not None:
        part = case.fit.report.validation
        found.append(
            f"the fitted plant leaves {part.rmse:.3g} {part.unit} rms of its record "
            "unexplained; that acts on the loop as a disturbance, the training part's "
            "while tuning, the validation part's in the hold-out"
        )
    if at_bound:
        found.append(f"at the edge of its bounds: {', '.join(at_bound)}")
    for where, figures in (("tuning", after), ("hold-out", holdout)):
        railed = [n for n, share in figures.saturated_percent.items() if share > 0]
        if railed:
            found.append(
                f"the actuator saturates on {where} runs of {', '.join(railed)}"
            )
        if not figures.stable:
            found.append(f"the tuned loop diverges or rails on {where} runs")
    return found
