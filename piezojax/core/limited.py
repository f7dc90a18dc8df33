"""Systems that limit their own output, and loops that are watched for it."""

import abc
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .arrays import Scalar, Signal, State
from .axes import PerAxis
from .feedback import Feedback, LoopSample
from .system import System

NEAR = 1e-9
"""Distance from an end that counts as none, as a share of the range: rounding."""


class Limited(System):
    """A System that clips its output, as a device clips its voltage."""

    @property
    @abc.abstractmethod
    def ends(self) -> tuple[Scalar, Scalar]:
        """Lowest and highest output."""


def at_limit(system: System, output: Any) -> Any:
    """Return whether ``output`` is at an end of a Limited part of ``system``.

    The system is resolved. There is one value for each axis of a PerAxis. None if no
    part is Limited.
    """
    if isinstance(system, PerAxis):
        each = [at_limit(*pair) for pair in zip(system.parts, output, strict=True)]
        if all(one is None for one in each):
            return None
        return tuple(jnp.asarray(False) if one is None else one for one in each)
    parts = jax.tree.leaves(system, is_leaf=lambda part: isinstance(part, Limited))
    ends = [part.ends for part in parts if isinstance(part, Limited)]
    if not ends or isinstance(output, tuple):
        return None
    found = jnp.asarray(False)
    for lower, upper in ends:
        inside = NEAR * (upper - lower)
        found |= (output <= lower + inside) | (output >= upper - inside)
    return found


class WatchedSample(NamedTuple):
    """LoopSample of a watched loop, in um and V.

    ``at_limit`` tells whether a limit of the controller's own holds the command; None
    if it has none.
    """

    reference: Signal
    displacement: Signal
    measured: Signal
    command: Signal
    voltage: Signal
    at_limit: Any


Sample = LoopSample | WatchedSample


class Watched(System):
    """A resolved ``loop`` whose samples tell whether its controller is at a limit.

    State and input are those of the loop, the output is a WatchedSample.
    """

    loop: Feedback

    def init(self, input: Any = 0.0) -> State:
        return self.loop.init(input)

    def step(self, state: State, input: Any) -> tuple[State, WatchedSample]:
        state, sample = self.loop.step(state, input)
        held = at_limit(self.loop.controller, sample.command)
        return state, WatchedSample(*sample, held)
