"""Share of the tracking error in the sliding variable of a controller."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ..control import ContinuousSlidingMode, SlidingMode, SwitchingLaw
from ..core.arrays import Scalar, State
from ..core.feedback import Feedback, LoopInput, LoopSample
from ..core.rollout import simulate
from ..core.system import System


class SlidingParts(NamedTuple):
    """RMS values of the sliding variable s = m e + de/dt and of its parts, um/s.

    ``sliding`` is s as the controller computes it from the measurement. ``error`` is
    m e + de/dt of the true displacement. ``rest`` is s minus that: the lag of the
    observer behind the motion, and sensor noise.
    """

    sliding: Scalar
    error: Scalar
    rest: Scalar

    @property
    def share(self) -> Scalar:
        """Mean square of ``error`` over that of ``error`` plus that of ``rest``."""
        return self.error**2 / (self.error**2 + self.rest**2)


class _WatchedState(NamedTuple):
    law: State
    sliding: Scalar


class _Watched(SwitchingLaw):
    """Switching law that stores the last s in its state."""

    law: SwitchingLaw

    def start(self, sliding: Any, output: Any) -> _WatchedState:
        return _WatchedState(self.law.start(sliding, output), jnp.asarray(sliding))

    def driven(self, state: _WatchedState, shortfall: Any) -> _WatchedState:
        return state._replace(law=self.law.driven(state.law, shortfall))

    def step(self, state: _WatchedState, input: Any) -> tuple[_WatchedState, Any]:
        law, output = self.law.step(state.law, input)
        return _WatchedState(law, input), output


class _Revealed(System):
    """Loop that also outputs the sliding variable of its watched law."""

    loop: Feedback

    def init(self, input: Any = 0.0) -> State:
        return self.loop.init(input)

    def step(
        self, state: State, input: LoopInput
    ) -> tuple[State, tuple[LoopSample, Scalar]]:
        state, sample = self.loop.step(state, input)
        leaves = jax.tree.leaves(state, is_leaf=_is_watched)
        (watched,) = (leaf for leaf in leaves if _is_watched(leaf))
        return state, (sample, watched.sliding)


def _is_watched(node: Any) -> bool:
    return isinstance(node, _WatchedState)


def _is_sliding(node: Any) -> bool:
    return isinstance(node, SlidingMode | ContinuousSlidingMode)


def _watched(node: Any) -> Any:
    if not _is_sliding(node):
        return node
    return eqx.tree_at(lambda mode: mode.law, node, _Watched(node.law))


def sliding_mode_of(loop: Feedback) -> SlidingMode | ContinuousSlidingMode | None:
    """Return the sliding mode of the controller if its s is m e + de/dt, else None.

    The result is None if there is no sliding mode, if there are several, or if the only
    one is a SlidingMode with a model whose order is not two.
    """
    nodes = jax.tree.leaves(loop.controller, is_leaf=_is_sliding)
    modes = [node for node in nodes if _is_sliding(node)]
    if len(modes) != 1:
        return None
    (mode,) = modes
    if isinstance(mode, SlidingMode) and len(mode.model.autoregressive) != 2:
        return None
    return mode


def sliding_parts(
    loop: Feedback, inputs: LoopInput, start: Any, first: int
) -> SlidingParts:
    """Return the SlidingParts of ``loop`` along ``inputs`` from sample ``first`` on.

    The run starts at rest at the reference ``start`` (um). Raises ValueError if
    ``sliding_mode_of(loop)`` is None.
    """
    mode = sliding_mode_of(loop)
    if mode is None:
        raise ValueError("the controller has no sliding variable m e + de/dt")
    controller = jax.tree.map(_watched, loop.controller, is_leaf=_is_sliding)
    revealed = _Revealed(Feedback(controller, loop.plant, loop.actuator, loop.sensor))
    sample, sliding = simulate(revealed, inputs, revealed.init(start))[1]
    error = sample.displacement - sample.reference
    slope = jnp.diff(error, prepend=error[:1]) / mode.filter.dt
    terms = mode.surface * error + slope
    return SlidingParts(
        *(
            jnp.sqrt(jnp.mean(part[first:] ** 2))
            for part in (sliding, terms, sliding - terms)
        )
    )
