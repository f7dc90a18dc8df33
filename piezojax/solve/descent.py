"""Gauss-Newton descent on the errors, with several dampings at once.

The loss of a control loop has long, narrow, curved valleys, in which gradient methods
zigzag. It is a sum of squared errors, so that their derivatives also give its
curvature. A step along a curved valley leaves its floor; the errors at its end and the
same derivatives correct it (simplified Newton method: Deuflhard, Newton Methods for
Nonlinear Problems, 2004).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .gauss_newton import EDGE, Quadratic, boxed_step, damped_solution
from .problem import FAILED_LOSS, Verdict

MOST = 0.5
"""Largest accepted correction as a share of its step."""

SAMPLES = 20_000
"""Number of errors, over all runs, from which the curvature is computed."""

SHORTEST = 5
"""Least distance between two of these errors, in samples."""

_ADDED = np.sqrt(2.0)  # the squares of the Lagrangian count fully, not half


class Ladder(NamedTuple):
    """Dampings of a descent, and the rule that adapts them.

    Each attempt tries the ``multiples`` of the present damping at once and takes the
    best point if it lowers the loss. The damping then becomes ``taken`` times that of
    this point, but at least ``least``. If no point lowers the loss, the damping grows
    by the factor ``rejected``; a step makes up to ``attempts`` attempts. The descent
    ends when the damping exceeds ``last``. Each point is corrected ``corrections``
    times with the derivatives at the start of the step.
    """

    first: float
    multiples: tuple[float, ...]
    taken: float
    rejected: float
    least: float
    last: float
    attempts: int
    corrections: int

    @property
    def evaluations(self) -> int:
        """Evaluations of the loss in a step with one attempt."""
        return 1 + len(self.multiples) * (1 + self.corrections)


PARALLEL = Ladder(
    first=1.0,
    multiples=tuple(10.0 ** np.linspace(-1.8, 0.9, 4)),
    taken=1.0,
    rejected=30.0,
    least=0.0,
    last=1e8,
    attempts=1,
    corrections=2,
)
"""Ladder for losses that cost as much at four points as at one, and for the unit box,
in which the curvature of a control loop is 1 to 1e6."""

SEQUENTIAL = Ladder(
    first=1e-3,
    multiples=(1.0,),
    taken=0.1,
    rejected=10.0,
    least=1e-9,
    last=3e5,
    attempts=15,
    corrections=0,
)
"""Ladder for losses much cheaper than their derivatives, and a metric of unit
diagonal."""


class Patience(NamedTuple):
    """Stopping rule: a descent ends if it gains too little in ``steps`` steps.

    The gain is too small below ``gain`` plus the share ``share`` of the loss before
    them.
    """

    steps: int
    gain: float = 0.0
    share: float = 0.0

    def exhausted(self, losses: Sequence[float]) -> bool:
        """Return whether ``losses``, one per step, have improved too little."""
        if len(losses) <= self.steps:
            return False
        before = losses[-1 - self.steps]
        return before - losses[-1] < self.gain + self.share * abs(before)


class Trials(NamedTuple):
    """Losses and Verdicts of points and, for corrections, the terms that are squared.

    These are a sample of the ``errors`` [points, runs, samples], and the terms
    ``added`` by the augmented Lagrangian [points, constraints].
    """

    losses: Any
    verdicts: Verdict
    errors: Any = None
    added: Any = None


class Derivatives(NamedTuple):
    """Loss, weights of the errors, and derivatives at a point.

    ``gradient`` is that of the loss, ``jacobian`` that of the errors and ``added`` that
    of the terms of the augmented Lagrangian.
    """

    loss: Float[Array, ""]
    weights: Float[Array, " runs"]
    gradient: Float[Array, " n"]
    jacobian: Float[Array, "n runs samples"]
    added: Float[Array, "n constraints"]


def trials_at(problem, units: Float[Array, "points n"], every: int) -> Trials:
    """Return the Trials of ``problem`` at ``units``, with one of ``every`` errors."""
    return Trials(*jax.vmap(lambda unit: problem.errors(unit, every)[:4])(units))


def derivatives_at(problem, unit: Float[Array, " n"], every: int) -> Derivatives:
    """Return value and derivatives at ``unit``, all in one forward pass."""

    def values(unit):
        point = problem.errors(unit, every)
        return (point.loss, point.errors, point.added), point.weights

    (loss, *_), (gradient, jacobian, added), weights = jax.vmap(
        lambda direction: jax.jvp(values, (unit,), (direction,), has_aux=True),
        out_axes=(None, 0, None),
    )(jnp.eye(unit.shape[0]))
    return Derivatives(loss, weights, gradient, jacobian, added)


def spacing(runs: int, counted: int) -> int:
    """Return the distance of the sampled errors, a prime number against aliasing."""
    most = max(2, counted // SHORTEST)
    wanted = min(max(SHORTEST, -(-runs * counted // SAMPLES)), most)
    return next(
        n for n in range(wanted, 2 * wanted + 1) if all(n % d for d in range(2, n))
    )


class LocalModel(NamedTuple):
    """Quadratic model of a loss at a point and, for corrections, its parts.

    ``jacobian`` [n, residuals] of the weighted errors, ``scale`` [runs, 1] their
    weights.
    """

    quadratic: Quadratic
    jacobian: Any = None
    scale: Any = None

    @classmethod
    def of(cls, here: Derivatives) -> "LocalModel | None":
        """Return the model from weighted errors, or None if it is not finite."""
        slopes, weights = np.asarray(here.jacobian), np.asarray(here.weights)
        gradient = np.asarray(here.gradient)
        scale = np.sqrt(np.maximum(weights, 0.0) / slopes.shape[2])[:, None]
        parts = (slopes * scale).reshape(slopes.shape[0], -1), _ADDED * here.added
        jacobian = np.concatenate(parts, axis=1)
        usable = np.all(np.isfinite(jacobian)) and np.all(np.isfinite(gradient))
        if not usable or here.loss >= FAILED_LOSS:
            return None
        return cls(Quadratic(gradient, jacobian @ jacobian.T), jacobian, scale)

    def residuals(self, errors: np.ndarray, added: np.ndarray) -> np.ndarray:
        """Return residuals, half of whose sum of squares is the loss."""
        return np.concatenate([(errors * self.scale).ravel(), _ADDED * added])

    def corrected(
        self, unit: np.ndarray, step: np.ndarray, moved: np.ndarray, damping: float
    ) -> np.ndarray:
        """Return ``step`` corrected towards the least damped sum of squares.

        The correction uses the residuals ``moved`` at the end of the step and the
        derivatives at ``unit``, and stays within the unit box.
        """
        free = (unit + step > EDGE) & (unit + step < 1.0 - EDGE)
        if not np.all(np.isfinite(moved)) or not free.any():
            return step
        force = -(self.jacobian @ moved + damping * step)
        change = np.zeros_like(step)
        change[free] = damped_solution(self.quadratic, force, damping, free)
        if np.linalg.norm(change) > MOST * np.linalg.norm(step):
            return step
        return np.clip(unit + step + change, 0.0, 1.0) - unit


@dataclass
class Descent:
    """Descent from one start; ``step`` advances it.

    ``linearise(unit)`` returns the LocalModel, or None if it is not finite.
    ``evaluate(units)`` returns the Trials of as many points as ``rule`` tries at once.
    ``patience`` and ``rule`` determine when the descent is ``done``. ``losses`` holds
    the loss after each step.
    """

    unit: np.ndarray
    loss: float
    verdict: Verdict
    linearise: Callable[[np.ndarray], LocalModel | None]
    evaluate: Callable[[np.ndarray], Trials]
    patience: Patience
    rule: Ladder = PARALLEL
    box: tuple[float, float] = (0.0, 1.0)
    done: bool = False
    losses: list[float] = field(default_factory=list)

    def __post_init__(self):
        self.damping = self.rule.first

    def step(self) -> int:
        """Move to the best point tried; return the number of evaluations."""
        model = self.linearise(self.unit)
        if model is None:
            self.done = True
            return 1
        taken = 1
        for _ in range(self.rule.attempts):
            dampings = self.damping * np.array(self.rule.multiples)
            best = self._attempt(model, dampings)
            taken += self.rule.evaluations - 1
            if best is not None:
                self.damping = max(self.rule.taken * dampings[best], self.rule.least)
                break
            self.damping *= self.rule.rejected
            if self.damping > self.rule.last:
                break
        self.losses.append(self.loss)
        self.done = self.damping > self.rule.last or self.patience.exhausted(
            self.losses
        )
        return taken

    def _attempt(self, model: LocalModel, dampings: np.ndarray) -> int | None:
        """Return the index of the damping of the best point, or None without a better
        one."""
        start = self.unit
        steps = [boxed_step(model.quadratic, start, d, self.box) for d in dampings]
        steps = np.clip(start + np.stack(steps), *self.box) - start
        trials = self.evaluate(start + steps)
        best = self._take(start + steps, trials, None)
        for _ in range(self.rule.corrections):
            residuals = map(
                model.residuals, np.asarray(trials.errors), np.asarray(trials.added)
            )
            steps = np.stack(
                [
                    model.corrected(start, step, moved, damping)
                    for step, moved, damping in zip(
                        steps, residuals, dampings, strict=True
                    )
                ]
            )
            trials = self.evaluate(start + steps)
            best = self._take(start + steps, trials, best)
        return best

    def _take(self, points: np.ndarray, trials: Trials, best: int | None) -> int | None:
        """Move to the best of ``points`` if it is better; return its index, else
        ``best``."""
        losses = np.asarray(trials.losses)
        leader = int(np.argmin(losses))
        if losses[leader] >= self.loss:
            return best
        self.unit, self.loss = points[leader], float(losses[leader])
        self.verdict = jax.tree.map(lambda x: np.asarray(x)[leader], trials.verdicts)
        return leader
