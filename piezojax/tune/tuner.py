"""Tuning: screen the box, descend from the best starts, judge on what was held out."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from .. import __version__
from .. import signals as signal_library
from .._types import as_array
from ..optimisers import METHODS
from ..progress import Progress, Silent
from ..rollout import in_blocks
from ..study import Case, read, shipped
from ..system import Feedback
from .objective import HOPELESS, Objective, Signals, evaluate, with_finite_gradient
from .result import Result, Scores, scores

STALL_STEPS, STALL_GAIN = 20, 1e-3
"""Stop when the best start gained less than this in so many steps."""

FORWARD_BELOW = 5
"""Fewer parameters than this are differentiated in forward mode."""

_SCREEN_LANES = 64  # lanes simulated at once while screening


@dataclass
class Outcome:
    """A Result with the loops and signals behind it, for pictures and further use."""

    result: Result
    before: Feedback
    after: Feedback
    case: Case

    @property
    def controller(self):
        """The tuned controller."""
        return self.after.controller


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
        tuning=Signals(references[:count], draws[0][:count]),
        holdout=Signals(references, draws[1]),
    )


class _Clock:
    """Splits wall time into compiling and running."""

    def __init__(self):
        self.began = time.perf_counter()
        self.compile_s = 0.0

    def compiled(self, function: Callable, *arguments: Any) -> Callable:
        start = time.perf_counter()
        program = jax.jit(function).lower(*arguments).compile()
        self.compile_s += time.perf_counter() - start
        return program

    def wall_s(self) -> float:
        return time.perf_counter() - self.began


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
    clock = _Clock()
    case = study if isinstance(study, Case) else read(study or shipped())
    table, space = case.study, case.space
    data = _make_data(case)
    first = round(table.references.settle * table.rate)

    progress.stage("simulating the start")
    judge = clock.compiled(
        lambda loop, signals: evaluate(loop, signals, first), case.loop, data.holdout
    )
    judge_tuning = (
        judge
        if data.tuning.noise.shape == data.holdout.noise.shape
        else clock.compiled(
            lambda loop, signals: evaluate(loop, signals, first), case.loop, data.tuning
        )
    )
    before = scores(judge_tuning(case.loop, data.tuning), data.names[: data.tuned])
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
    search = _search(objective, case, clock, progress)

    progress.stage("judging on held-out noise")
    after = space.put(case.loop, as_array(search.unit))
    result = _report(case, data, judge, judge_tuning, before, after, search, clock)
    return Outcome(result, case.loop, after, case)


def _scale(before: Scores, references: jax.Array) -> jax.Array:
    # Where the start diverges its error is no measure; the reference's own swing is.
    swing = jnp.maximum(jnp.std(references, axis=1), 1e-3)
    if not before.stable:
        return swing
    return as_array([rms or 1e-9 for rms in before.per_reference_rms_um.values()])


@dataclass
class _Search:
    unit: np.ndarray
    status: str
    evaluations: int
    history: list[list[float | None]]
    warnings: list[str]


def _search(
    objective: Objective, case: Case, clock: _Clock, progress: Progress
) -> _Search:
    table, space = case.study.optimiser, case.space
    own = np.asarray(space.start(case.loop))
    search = _Search(own, "step limit", 0, [], [])
    best = np.inf
    try:
        starts, losses = _screen(objective, own, case, clock, progress)
        search.evaluations += losses.size
        _judge_starts(losses, own, starts, search)
        keep = np.argsort(losses[1:], kind="stable")[: table.starts - 1] + 1
        chosen = np.concatenate([[0], keep]) if losses[0] < HOPELESS else keep
        best, search.unit = losses.min(), starts[losses.argmin()]
        _descend(objective, starts[chosen], best, search, case, clock, progress)
    except KeyboardInterrupt:
        search.status = "interrupted"
    return search


def _screen(objective, own, case, clock, progress) -> tuple[np.ndarray, np.ndarray]:
    table = case.study.optimiser
    candidates = max(table.candidates, table.starts - 1)
    # Sobol points are balanced in powers of two.
    power = int(np.ceil(np.log2(max(candidates, 1))))
    sampler = qmc.Sobol(own.size, rng=np.random.default_rng(case.study.seed))
    points = sampler.random_base2(power)[:candidates]
    points = np.concatenate([own[None], points])
    lanes = objective.signals.noise.shape[0] * objective.signals.noise.shape[1]
    progress.stage(f"screening {len(points)} points of the box")
    program = clock.compiled(
        lambda objective, units: in_blocks(
            lambda unit: objective.loss(unit),
            units,
            size=max(1, _SCREEN_LANES // lanes),
        ),
        objective,
        as_array(points),
    )
    return points, np.asarray(program(objective, as_array(points)))


def _judge_starts(losses, own, points, search) -> None:
    if not np.any(losses < HOPELESS):
        raise ValueError(
            f"the loop diverges at the start and at all {losses.size - 1} other points "
            "tried in the box: lower the bounds of the gains, raise 'candidates', or "
            "check the plant's sign and sample rate"
        )
    if losses[0] >= HOPELESS:
        search.warnings.append(
            "the study's own start diverges; tuning began from the best of "
            f"{losses.size - 1} other points of the box instead"
        )


def _descend(objective, starts, best, search, case, clock, progress) -> None:
    table = case.study.optimiser
    forward = len(case.space.paths) < FORWARD_BELOW

    def optimiser(objective):
        # A lambda, because a bound method would be hashed with its arrays.
        loss = with_finite_gradient(lambda u: objective.loss(u), forward=forward)
        return METHODS[table.method](
            loss, lambda u: objective.residuals(u), table.tolerance
        )

    progress.stage("compiling the gradient")
    carry = jax.jit(
        lambda objective, units: jax.vmap(optimiser(objective).start)(units)
    )(objective, as_array(starts))

    def advance(objective, carry):
        solver = optimiser(objective)
        carry = jax.vmap(solver.step)(carry)
        return carry, jax.vmap(solver.view)(carry)

    program = clock.compiled(advance, objective, carry)
    progress.stage(f"tuning from {len(starts)} starts", table.steps)
    bests: list[float] = []
    lowest = np.full(len(starts), np.inf)
    for _ in range(table.steps):
        carry, view = program(objective, carry)
        view = jax.tree.map(np.asarray, view)
        search.evaluations += len(starts)
        losses = np.where(np.isfinite(view.loss), view.loss, np.inf)
        lowest = np.minimum(lowest, losses)
        search.history.append([float(x) if np.isfinite(x) else None for x in lowest])
        leader = int(np.argmin(losses))
        if losses[leader] < best:
            best, search.unit = losses[leader], view.unit[leader]
        bests.append(float(best))
        progress.advance(float(best))
        if np.all(view.done) or _stalled(bests):
            search.status = "converged"
            break


def _stalled(bests: list[float]) -> bool:
    return len(bests) > STALL_STEPS and bests[-1 - STALL_STEPS] - bests[-1] < STALL_GAIN


def _report(case, data, judge, judge_tuning, before, after, search, clock) -> Result:
    tuned = data.names[: data.tuned]
    unseen = data.names[data.tuned :]

    def held(loop: Feedback) -> tuple[Scores, Scores | None]:
        figures = judge(loop, data.holdout)
        head = jax.tree.map(lambda x: x[: data.tuned], figures)
        tail = jax.tree.map(lambda x: x[data.tuned :], figures)
        return scores(head, tuned), scores(tail, unseen) if unseen else None

    holdout_before, unseen_before = held(case.loop)
    holdout, unseen_after = held(after)
    after_scores = scores(judge_tuning(after, data.tuning), tuned)
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
        warnings=[*search.warnings, *_warnings(at_bound, after_scores, holdout)],
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


def _warnings(at_bound: list[str], after: Scores, holdout: Scores) -> list[str]:
    found = []
    if at_bound:
        found.append(f"at the edge of its bounds: {', '.join(at_bound)}")
    for where, figures in (("tuning", after), ("hold-out", holdout)):
        railed = [n for n, share in figures.saturated_percent.items() if share > 0]
        if railed:
            found.append(
                f"the actuator saturates on {where} runs of {', '.join(railed)}"
            )
        if not figures.stable:
            found.append(f"the tuned loop diverges on {where} runs")
    return found
