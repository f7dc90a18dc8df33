"""Reference anticipation: a controller that receives its reference early."""

from typing import Any

from ..core.arrays import Scalar, State, as_scalars
from ..core.axes import Axes
from ..core.feedback import Observation
from ..core.parameter import parameter
from ..core.system import System


class Anticipation(System):
    """``controller`` with its reference advanced by ``lead`` samples.

    A closed loop lags its reference by a time that depends on its tuning. A reference
    advanced by the same time removes the lag and leaves the feedback, its noise and its
    margins unchanged. A lead of 0 gives r(k), and a lead of 1 gives r(k+1), which is
    known; a larger one extrapolates the line through r(k) and r(k+1). Input an
    Observation, output that of ``controller``.
    """

    controller: System
    lead: tuple[Scalar, ...] = parameter(
        "samples",
        "advance of the reference, one number per axis",
        typical=(-5.0, 30.0),
        converter=as_scalars,
    )

    def _advanced(self, input: Observation) -> Observation:
        now, following = input.reference, input.next_reference
        if isinstance(now, tuple):
            pairs = [
                _shifted(r, r_next, lead)
                for r, r_next, lead in zip(now, following, self.lead, strict=True)
            ]
            now, following = (tuple(part) for part in zip(*pairs, strict=True))
        else:
            (lead,) = self.lead
            now, following = _shifted(now, following, lead)
        return input._replace(reference=now, next_reference=following)

    def init(self, input: Observation) -> State:
        return self.controller.init(self._advanced(input))

    def step(self, state: State, input: Observation) -> tuple[State, Any]:
        return self.controller.step(state, self._advanced(input))


def _shifted(now: Scalar, following: Scalar, samples: Scalar) -> Axes:
    rise = samples * (following - now)
    return now + rise, following + rise
