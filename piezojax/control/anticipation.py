"""A controller that is shown its reference a little ahead of time."""

from typing import Any

import equinox as eqx

from .._types import Scalar, State, as_scalars, check
from ..axes import Axes
from ..system import Observation, System


class Anticipation(System):
    """``controller``, shown the reference ``lead`` seconds ahead, by extrapolation.

    A closed loop follows late by a time that its tuning fixes; a reference shown
    earlier by as much takes that away without touching the feedback, its noise or its
    margins. The slope is that of the last step that is known, r(k+1) - r(k), so a
    signal is foreseen as well as a straight line serves over ``lead``. One value for
    each axis; 0 changes nothing; ``dt`` in s. Input an Observation, output the
    controller's. Raises ValueError for a lead that is not finite or ``dt <= 0``.
    """

    controller: System
    lead: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("lead in s", self.lead)
        check("sample time in s", self.dt, above=0.0)

    def _ahead(self, input: Observation) -> Observation:
        now, following = input.reference, input.next_reference
        if isinstance(now, tuple):
            pairs = [
                _shifted(r, r_next, lead / self.dt)
                for r, r_next, lead in zip(now, following, self.lead, strict=True)
            ]
            now, following = (tuple(part) for part in zip(*pairs, strict=True))
        else:
            (lead,) = self.lead
            now, following = _shifted(now, following, lead / self.dt)
        return input._replace(reference=now, next_reference=following)

    def init(self, input: Observation) -> State:
        return self.controller.init(self._ahead(input))

    def step(self, state: State, input: Observation) -> tuple[State, Any]:
        return self.controller.step(state, self._ahead(input))


def _shifted(now: Scalar, following: Scalar, samples: Scalar) -> Axes:
    rise = samples * (following - now)
    return now + rise, following + rise
