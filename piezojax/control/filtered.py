"""Controller whose measurements are filtered by an observer."""

from typing import Any

import jax

from ..core.arrays import State
from ..core.feedback import Observation
from ..core.system import System
from .observer import Motion


def _is_motion(node: Any) -> bool:
    return isinstance(node, Motion)


class Filtered(System):
    """``controller`` with the position estimated by ``filter`` in place of z(k).

    ``filter`` is an Observer, or one on each axis (``PerAxis``); its velocities are not
    used. All parts of ``controller``, including a disturbance observer, see the
    filtered position. Input an Observation, output that of ``controller``.
    """

    filter: System
    controller: System

    def init(self, input: Observation) -> State:
        return self.filter.init(input), self.controller.init(input)

    def step(self, state: State, input: Observation) -> tuple[State, Any]:
        filter_state, motion = self.filter.step(state[0], input)
        position = jax.tree.map(lambda m: m.position, motion, is_leaf=_is_motion)
        observation = input._replace(measured=position)
        controller, command = self.controller.step(state[1], observation)
        return (filter_state, controller), command
