"""Descents in step: an optimiser of ``optimisers`` from all starts at once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..core.arrays import as_array
from ..core.progress import Progress
from ..core.rollout import BLOCK, in_blocks
from ..solve.clock import Clock
from ..solve.optimisers import METHODS
from ..study import Case
from .constraints import updated
from .gradient import with_finite_gradient
from .lagrangian import prepared, rounds
from .objective import Objective, Verdict
from .search_state import Search

STALL_STEPS, STALL_GAIN = 20, 1e-3
"""Stop when the best start gained less than this in so many steps."""

FORWARD_BELOW, FORWARD_BELOW_WITH_AXES = 5, 64
"""Fewer parameters than this are differentiated in forward mode: with several axes the
reverse pass takes minutes to compile, three times as long."""


class Together:
    """Descends by an optimiser that knows one point, vmapped over the starts."""

    def __init__(self, objective: Objective, case: Case, clock: Clock):
        self.objective = prepared(objective)
        self._table, self._clock = case.study.optimiser, clock
        below = FORWARD_BELOW_WITH_AXES if case.study.axes else FORWARD_BELOW
        self._forward = len(case.space.paths) < below
        self._programs: dict[int, tuple[Any, Any, Any]] = {}

    def losses(self, points: np.ndarray) -> tuple[np.ndarray, Verdict]:
        """Return loss and verdict of any number of points."""
        at_once = max(1, BLOCK // self.objective.lanes)
        program = self._clock.compiled(
            lambda objective, units: in_blocks(
                lambda unit: objective.both(unit), units, size=at_once
            ),
            self.objective,
            as_array(points),
        )
        found = program(self.objective, as_array(points))
        return jax.tree.map(np.asarray, found)

    def wait(self) -> None:
        """Do nothing: everything is compiled when it is needed."""

    def descend(
        self,
        objective: Objective,
        starts: np.ndarray,
        search: Search,
        steps: int,
        progress: Progress,
    ) -> None:
        """Improve ``search`` from ``starts`` by up to ``steps`` steps."""
        progress.stage("compiling the gradient")
        begin, advance, violated = self._compiled(len(starts))
        progress.stage(f"tuning from {len(starts)} starts", steps)
        objective = objective.with_multipliers(self.objective.multipliers)
        units, places = as_array(starts), np.arange(len(starts))
        multipliers = jnp.zeros((len(starts), objective.multipliers.size))
        for penalty, share, last in rounds(objective, steps):
            objective = objective.with_penalty(penalty)
            carry = begin(objective, units, multipliers)
            bests: list[float] = []
            for _ in range(share):
                carry, view, verdict = advance(objective, carry, multipliers)
                units = view.unit
                view, verdict = jax.tree.map(np.asarray, (view, verdict))
                search.record(verdict, places)
                search.offer(view.unit, verdict)
                bests.append(float(np.min(view.loss)))
                progress.advance(search.loss)
                if np.all(view.done) or _stalled(bests):
                    search.status = "converged" if last else search.status
                    break
            if not last:
                found = violated(objective, units)
                multipliers = updated(found, multipliers, as_array(penalty))

    def _compiled(self, starts: int) -> tuple[Any, Any, Any]:
        """Return the programs that begin, advance, and say what is violated."""
        if starts in self._programs:
            return self._programs[starts]
        table, forward = self._table, self._forward

        def optimiser(objective, multipliers):
            objective = objective.with_multipliers(multipliers)
            # A lambda, because a bound method would be hashed with its arrays.
            loss = with_finite_gradient(lambda u: objective.loss(u), forward=forward)
            return METHODS[table.method](
                loss, lambda u: objective.residuals(u), table.tolerance
            )

        def begin(objective, units, multipliers):
            return jax.vmap(lambda u, m: optimiser(objective, m).start(u))(
                units, multipliers
            )

        def advance(objective, carry, multipliers):
            def one(carry, multipliers):
                solver = optimiser(objective, multipliers)
                carry = solver.step(carry)
                view = solver.view(carry)
                if objective.limits:
                    return carry, view, objective.verdict(view.unit)
                return carry, view, Verdict(view.loss, jnp.zeros(()))

            return jax.vmap(one)(carry, multipliers)

        def violated(objective, units):
            return jax.vmap(lambda unit: objective.violated(unit))(units)

        objective = self.objective
        units = jnp.full((starts, len(objective.space.paths)), 0.5)
        multipliers = jnp.zeros((starts, objective.multipliers.size))
        carry = jax.eval_shape(begin, objective, units, multipliers)
        compiled = self._clock.compiled
        self._programs[starts] = (
            compiled(begin, objective, units, multipliers),
            compiled(advance, objective, carry, multipliers),
            compiled(violated, objective, units) if objective.limits else None,
        )
        return self._programs[starts]


def _stalled(bests: list[float]) -> bool:
    return len(bests) > STALL_STEPS and bests[-1 - STALL_STEPS] - bests[-1] < STALL_GAIN
