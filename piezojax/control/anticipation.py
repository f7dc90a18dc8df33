"""A controller that is shown its reference a little ahead of time."""

from typing import Any

import equinox as eqx

from ..core.arrays import Scalar, State, as_scalars, check
from ..core.axes import Axes
from ..core.system import Observation, System


class Anticipation(System):
    """``controller``, shown the reference ``lead`` samples ahead.

    A closed loop follows late by a time that its tuning fixes; a reference shown
    earlier by as much takes that away without touching the feedback, its noise or its
    margins. 1 is r(k+1), which is known; beyond, the line through r(k) and r(k+1) goes
    on, so a signal is foreseen as well as a straight line serves. One value for each
    axis; 0 changes nothing. Input an Observation, output the controller's. Raises
    ValueError for a lead that is not finite.
    """

    controller: System
    lead: tuple[Scalar, ...] = eqx.field(converter=as_scalars)

    def __check_init__(self):
        check("lead in samples", self.lead)

    def _ahead(self, input: Observation) -> Observation:
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
        return self.controller.init(self._ahead(input))

    def step(self, state: State, input: Observation) -> tuple[State, Any]:
        return self.controller.step(state, self._ahead(input))


def _shifted(now: Scalar, following: Scalar, samples: Scalar) -> Axes:
    rise = samples * (following - now)
    return now + rise, following + rise
