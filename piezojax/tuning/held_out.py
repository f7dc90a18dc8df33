"""Figures of a loop on the hold-out, shared by the result and the comparisons."""

from dataclasses import dataclass, replace
from functools import cached_property

from ..analysis.constraints import LoopFigures
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


def held_out_loops(
    case: Case, evaluator: Evaluator, data: Data, after: Feedback
) -> dict[str, HeldOut]:
    """Return the loops "before" and "tuned", which is ``after``, on the hold-out."""
    stages = case.ensemble.stages("holdout") if case.ensemble else None
    before = HeldOut(evaluator, case.loop, data.holdout, stages)
    return {"before": before, "tuned": replace(before, loop=after)}
