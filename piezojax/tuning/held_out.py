"""Figures of a loop on the hold-out, shared by the result and the comparisons."""

from dataclasses import dataclass, replace
from functools import cached_property

from ..analysis.loop_figures import LoopFigures
from ..core.feedback import Feedback
from ..study import Case, Stage
from .data import Data
from .evaluator import Evaluator
from .runs import Signals


@dataclass(frozen=True)
class HeldOut:
    """Figures of ``loop`` on the held-out ``signals``, computed when first used.

    ``stages`` are the perturbed plants of the hold-out, None if there are none.
    """

    evaluator: Evaluator
    loop: Feedback
    signals: Signals
    stages: Stage | None

    @cached_property
    def nominal(self) -> LoopFigures:
        """Figures on the plant of the loop: one plant on the first axis."""
        return self.evaluator.limited(self.loop, self.signals)

    @cached_property
    def perturbed(self) -> LoopFigures | None:
        """Figures on the perturbed plants, or None if there are none."""
        if self.stages is None:
            return None
        return self.evaluator.limited(self.loop, self.signals, self.stages, self.stages)

    def on(self, signals: Signals) -> "HeldOut":
        """Return the same loop on ``signals``."""
        return self if signals is self.signals else replace(self, signals=signals)

    def with_loop(self, loop: Feedback) -> "HeldOut":
        """Return ``loop`` on the same signals and plants."""
        return replace(self, loop=loop)


def held_out(case: Case, evaluator: Evaluator, data: Data) -> HeldOut:
    """Return the loop of the study on the hold-out."""
    stages = case.ensemble.stages("holdout") if case.ensemble else None
    return HeldOut(evaluator, case.loop, data.holdout, stages)
