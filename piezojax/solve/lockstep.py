"""Lockstep descent: an optimiser of ``optimisers.METHODS`` from all starts at once."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.arrays import as_array
from ..core.progress import Progress
from .augmented_lagrangian import with_zero_multipliers
from .clock import Clock
from .gradient import with_finite_gradient
from .multi_start import BatchedDescents, Patience, in_batches
from .optimisers import METHODS, Optimiser, View
from .problem import Problem, Verdict

STALLED = Patience(20, gain=1e-3)
"""Patience with the best start: a gain of 1e-3 in 20 steps."""


class _Settings(NamedTuple):
    """Name and tolerance of the optimiser, and whether gradients are forward-mode."""

    method: str
    tolerance: float
    forward: bool


class LockstepDescent:
    """Descents of the optimiser ``method`` on ``problem``, vmapped over the starts.

    ``size`` is the number of unknowns, ``tolerance`` that of the optimiser;
    ``forward`` selects forward-mode gradients. Screening evaluates ``at_once`` points
    together.
    """

    cut = None
    patience = STALLED
    finalists = None

    def __init__(
        self,
        problem: Problem,
        size: int,
        clock: Clock,
        *,
        method: str,
        tolerance: float,
        forward: bool,
        at_once: int,
    ):
        self._problem = with_zero_multipliers(problem)
        self._size, self._clock, self._at_once = size, clock, at_once
        self._settings = _Settings(method, tolerance, forward)
        self._programs: dict[int, tuple[Any, Any]] = {}
        self._screening: Callable[..., Any] | None = None
        self._width = 0

    @property
    def constraints(self) -> int:
        """Number of constraints, each with a multiplier."""
        return self._problem.multipliers.size

    def screen(self, problem: Problem, units: np.ndarray) -> tuple[np.ndarray, Verdict]:
        """Return loss, without multipliers, and verdict of any number of points.

        The first call compiles the program for the number of its points, or for
        ``at_once`` points if that is smaller.
        """
        if self._screening is None:
            self._width = min(self._at_once, len(units))
            self._screening = self._clock.compiled(
                _screened,
                self._problem,
                as_array(units[: self._width]),
            )
        program = self._screening
        problem = problem.with_multipliers(self._problem.multipliers)
        return in_batches(lambda batch: program(problem, batch), units, self._width)

    def wait(self) -> None:
        """Do nothing, because no program compiles in the background."""

    def prepare(self, starts: int, progress: Progress) -> None:
        """Compile the programs that begin and advance the descents."""
        progress.stage("compiling the gradient")
        if starts in self._programs:
            return
        problem, settings = self._problem, self._settings
        units = jnp.full((starts, self._size), 0.5)
        multipliers = jnp.zeros((starts, self.constraints))
        carry = _begun.eval_shape(settings, problem, units, multipliers)
        compiled = self._clock.compiled
        self._programs[starts] = (
            compiled(_begun, settings, problem, units, multipliers),
            compiled(_advanced, settings, problem, carry, multipliers),
        )

    def begin(
        self, problem: Problem, units: np.ndarray, multipliers: Array
    ) -> tuple[BatchedDescents, int]:
        """Return descents from ``units``, and the number of evaluations used."""
        begin, advance = self._programs[len(units)]
        problem = problem.with_multipliers(self._problem.multipliers)

        def advanced(carry: Any) -> tuple[Any, View, Verdict]:
            carry, view = advance(problem, carry, multipliers)
            if problem.limits:
                # The screening program computes the verdicts, so that the program of a
                # step stays smaller.
                return carry, view, self.screen(problem, np.asarray(view.unit))[1]
            return carry, view, Verdict(view.loss, np.zeros((len(view.loss), 0)))

        started = begin(problem, as_array(units), multipliers)
        return BatchedDescents(advanced, started, len(units)), 0


@jax.jit
def _screened(problem: Any, units: Array) -> tuple[Array, Verdict]:
    return jax.vmap(lambda unit: problem.value_and_verdict(unit))(units)


def _optimiser(settings: _Settings, problem: Any, multipliers: Array) -> Optimiser:
    problem = problem.with_multipliers(multipliers)
    # A lambda, because JAX would hash a bound method, and arrays have no hash.
    loss = with_finite_gradient(
        lambda unit: problem.loss(unit), forward=settings.forward
    )
    make = METHODS[settings.method]
    return make(loss, lambda unit: problem.residuals(unit), settings.tolerance)


@partial(jax.jit, static_argnums=0)
def _begun(settings: _Settings, problem: Any, units: Array, multipliers: Array) -> Any:
    return jax.vmap(lambda u, m: _optimiser(settings, problem, m).start(u))(
        units, multipliers
    )


@partial(jax.jit, static_argnums=0)
def _advanced(settings: _Settings, problem: Any, carry: Any, multipliers: Array) -> Any:
    def advance_one(carry, multipliers):
        solver = _optimiser(settings, problem, multipliers)
        carry = solver.step(carry)
        return carry, solver.view(carry)

    return jax.vmap(advance_one)(carry, multipliers)
