"""Damped Gauss-Newton: descents from several starts that advance side by side.

The loss of a control loop has long, narrow, curved valleys, in which gradient methods
zigzag. The loss is a sum of squared errors, so the derivatives of the errors also give
its curvature. A step along a curved valley leaves the floor of the valley; the errors
at the end of the step, with the derivatives at its start, correct it (simplified Newton
method: Deuflhard, Newton Methods for Nonlinear Problems, 2004).

One driver serves tuning and every fit. Searches differ in their ``Damping``, in their
box (a problem searched through a sigmoid has none) and in the functions that return
trials and models.
"""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from .local_model import UNBOUNDED, Box, LocalModel
from .multi_start import DescentStatus, Patience, in_batches


class Damping(NamedTuple):
    """Rule that proposes steps, accepts them and adapts the damping.

    Each attempt tries the ``multiples`` of the present damping at once, and each point
    is corrected ``corrections`` times. The best point is accepted if it achieves more
    than the share ``enough`` of the predicted decrease of the loss. The damping becomes
    that of this point, times ``shrink`` if it achieves more than the share ``good``,
    but at least ``least``. If no point is accepted, the damping grows by the factor
    ``grow``; a step makes up to ``attempts`` attempts. The descent ends when the
    damping exceeds ``last``.
    """

    first: float = 1.0
    multiples: tuple[float, ...] = (1.0,)
    corrections: int = 0
    enough: float = 0.0
    good: float = 0.0
    shrink: float = 1.0
    least: float = 0.0
    grow: float = 4.0
    attempts: int = 1
    last: float = np.inf


PARALLEL = Damping(
    multiples=tuple(10.0 ** np.linspace(-1.8, 0.9, 4)),
    corrections=2,
    grow=30.0,
    attempts=4,
    last=1e8,
)
"""Rule for losses that cost as much at four points as at one, and for the unit box, in
which the curvature of a control loop is 1 to 1e6."""

SEQUENTIAL = Damping(
    first=1e-3, shrink=0.1, least=1e-9, grow=10.0, attempts=15, last=3e5
)
"""Rule for losses much cheaper than their derivatives, and for a metric that scales the
curvature to unit diagonal."""

TRUST_REGION = Damping(enough=0.01, good=0.75, shrink=1.0 / 3.5)
"""Rule for losses that are computed together with their derivatives. The constants are
those of optimistix (Gould et al. 2005, 4OR 3), except that the damping falls after 3/4
of the predicted decrease: with 0.99 the steps through a curved valley stay short."""


class Trials(NamedTuple):
    """Losses [points] of the points that a descent tries at once.

    The other fields are optional: Verdicts, ``residuals`` [points, residuals] for
    corrections, and ``models`` of the points if the derivatives are computed together
    with the losses.
    """

    losses: np.ndarray
    verdicts: Any = None
    residuals: Any = None
    models: Sequence[LocalModel] | None = None


@dataclass
class Descent:
    """Descent from one start: its settings, best point and state between steps.

    It is ``done`` when the damping exceeds its last value, ``patience`` is exhausted,
    the derivatives are not finite, or a step and the change of the loss fall below
    ``tolerance``, relative to the point and the loss. ``losses`` holds the loss after
    each step.
    """

    point: np.ndarray
    rule: Damping
    box: Box = UNBOUNDED
    patience: Patience | None = None
    tolerance: float = 0.0
    loss: float = np.inf
    verdict: Any = None
    model: LocalModel | None = None
    done: bool = False
    losses: list[float] = field(default_factory=list)

    def __post_init__(self):
        self.damping = self.rule.first

    def step(self) -> Generator[np.ndarray, Trials, None]:
        """Yield points [points, n] to try, receive Trials, and move to an accepted one.

        Without a model only the present point is tried.
        """
        if self.model is None:
            self._move(self.point, (yield self.point[None]), 0)
            self.done = self.model is None
        else:
            yield from self._attempts(self.model)
        self.losses.append(self.loss)
        self.done |= self.damping > self.rule.last
        self.done |= bool(self.patience and self.patience.exhausted(self.losses))

    def _attempts(self, model: LocalModel) -> Generator[np.ndarray, Trials, None]:
        """Try several dampings, and larger ones until a point is accepted."""
        start, box = model.point, self.box
        for _ in range(self.rule.attempts):
            dampings = self.damping * np.array(self.rule.multiples)
            steps = np.stack([model.step(damping, box) for damping in dampings])
            steps = np.clip(start + steps, *box) - start
            trials = yield start + steps
            taken = self._take(model, steps, dampings, trials)
            for _ in range(self.rule.corrections):
                tried = zip(steps, trials.residuals, dampings, strict=True)
                steps = np.stack([model.corrected(*one, box) for one in tried])
                trials = yield start + steps
                taken = self._take(model, steps, dampings, trials) or taken
            if taken:
                self.damping = max(taken, self.rule.least)
                return
            self.damping *= self.rule.grow
            if self.damping > self.rule.last:
                return

    def _take(
        self,
        model: LocalModel,
        steps: np.ndarray,
        dampings: np.ndarray,
        trials: Trials,
    ) -> float | None:
        """Move to the best trial if it is accepted; return the next damping, or None
        otherwise."""
        best = int(np.argmin(trials.losses))
        step, predicted = steps[best], model.predicted(steps[best])
        change = float(trials.losses[best]) - self.loss
        size, place = np.sqrt(model.metric) * np.abs([step, model.point])
        near = np.all(size < self.tolerance * (1.0 + place))
        level = abs(change) < self.tolerance * (1.0 + self.loss)
        self.done |= bool(near and level)
        if not change < self.rule.enough * predicted:
            return None
        self._move(model.point + step, trials, best)
        good = change < self.rule.good * predicted
        return dampings[best] * (self.rule.shrink if good else 1.0)

    def _move(self, point: np.ndarray, trials: Trials, best: int) -> None:
        """Move to ``point``, the trial ``best``."""
        self.point, self.loss = point, float(trials.losses[best])
        self.verdict = jax.tree.map(lambda x: np.asarray(x)[best], trials.verdicts)
        model = trials.models[best] if trials.models else None
        if model and self.model:
            # Derivatives that come with the losses keep the metric of the start.
            model = model._replace(metric=self.model.metric)
        self.model = model if model and model.finite else None


class GaussNewton:
    """Damped Gauss-Newton descents from several starts that advance side by side.

    ``evaluate`` returns the Trials of points [descents, points, n], one for each
    descent. ``linearise`` returns the LocalModel at each of the points [descents, n],
    or None if it is not finite; it is not needed if the Trials have models.
    """

    def __init__(
        self,
        descents: Sequence[Descent],
        evaluate: Callable[[np.ndarray], Sequence[Trials]],
        linearise: Callable[[np.ndarray], Sequence[LocalModel | None]] | None = None,
    ):
        self._descents, self._places = list(descents), np.arange(len(descents))
        self._evaluate, self._linearise = evaluate, linearise

    def advance(self) -> DescentStatus:
        """Move every descent by one step; return their status."""
        moving = [descent for descent in self._descents if not descent.done]
        taken = self._update_models(moving)
        steps = (descent.step() for descent in moving if not descent.done)
        asked = {step: next(step) for step in steps}
        while asked:
            points = np.stack(list(asked.values()))
            taken += len(points) * points.shape[1]
            answers = zip(asked, self._evaluate(points), strict=True)
            more = {step: _next_points(step, trials) for step, trials in answers}
            asked = {step: new for step, new in more.items() if new is not None}
        every = self._descents
        return DescentStatus(
            np.array([descent.point for descent in every]),
            np.array([descent.loss for descent in every]),
            jax.tree.map(lambda *parts: np.stack(parts), *(d.verdict for d in every)),
            np.array([descent.done for descent in every]),
            self._places,
            taken,
        )

    def _update_models(self, moving: Sequence[Descent]) -> int:
        """Compute the missing models; return the number of evaluations."""
        stale = [descent for descent in moving if descent.model is None]
        if not stale or self._linearise is None:
            return 0
        models = self._linearise(np.stack([descent.point for descent in stale]))
        for descent, model in zip(stale, models, strict=True):
            descent.model, descent.done = model, model is None
        return len(stale)

    def keep(self, rows: np.ndarray) -> None:
        """Keep only the descents at ``rows`` of the last DescentStatus."""
        self._descents = [self._descents[row] for row in rows]
        self._places = self._places[rows]


def _next_points(
    step: Generator[np.ndarray, Trials, None], trials: Trials
) -> np.ndarray | None:
    """Send ``trials`` to a step; return its next points, or None at its end."""
    try:
        return step.send(trials)
    except StopIteration:
        return None


def trials_with_models(
    program: Callable[[Array], tuple[Any, Any, Any]],
    width: int,
    metric: Callable[[np.ndarray], Any] = lambda curvature: 1.0,
) -> Callable[[np.ndarray], list[Trials]]:
    """Return the ``evaluate`` of descents that try one point at a time.

    ``program`` returns the ``normal_equations`` at ``width`` points. ``metric`` returns
    the metric of the models from the curvature.
    """

    def evaluate(points):
        points = points[:, 0]
        rows = zip(points, *in_batches(program, points, width), strict=True)
        return [
            Trials(loss[None], models=[LocalModel(point, slope, bend, metric(bend))])
            for point, loss, slope, bend in rows
        ]

    return evaluate
