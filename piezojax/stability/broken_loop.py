"""A loop cut at the input of its plant: what margins are about."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._types import Scalar, ScalarLike, State, as_array
from ..dynamics import StateSpace
from ..hardware import Saturation
from ..system import Affine, Feedback, LoopState, Observation, System
from .linearise import linearise, sample_time

BRANCHES = {"ascending": 1.0, "descending": -1.0}
"""Ways in which the plant's input may be about to move, by name."""

VOLTAGE_PUSH = 2.0**-40
"""Push on voltages, over 1 + |u|: enough to pick a branch, too little to move on it."""

COMMAND_PUSH = 2.0**-30
"""Push on the command, by way of the reference, over 1 + |u|: larger than the other,
for an inverse hysteresis in the controller to be on the same branch."""


class BrokenState(NamedTuple):
    """A loop's state without its reference; ``applied`` is the actuator's own."""

    controller: State
    actuator: State
    plant: State
    sensor: State
    displacement: Scalar
    applied: Scalar


class BrokenLoop(System):
    """A Feedback loop cut between its actuator and its plant.

    Input: the voltage injected into the plant, V. Output: minus the voltage that the
    actuator then returns, V, so that the loop is closed by feeding back minus the
    output, and its transfer function L has the critical point -1.

    The cut lies behind the point where the controller learns what was applied:
    ``applied`` stays the actuator's own last voltage. A disturbance observer so keeps
    its inner loop, and L is the plant times everything the controller does to a
    measurement: the margins are those against a gain, a phase or a delay of the
    amplifier, the stage or the sensor that the controller does not know of. (With the
    cut before that point the controller would be told of the change, and the margins
    would be too good.)

    Use ``broken_loop`` to make one. ``reference`` (um) is held; the pushes (V, um) pick
    a branch where a step has kinks; without them this is the loop as it runs.
    """

    loop: Feedback
    reference: Scalar = eqx.field(converter=as_array)
    start: LoopState
    voltage_push: Scalar = eqx.field(converter=as_array, default=0.0)
    reference_push: Scalar = eqx.field(converter=as_array, default=0.0)

    def init(self, input: Any = None) -> BrokenState:
        """Return the state of the operating point, whatever the input."""
        start = self.start
        return BrokenState(
            controller=start.controller,
            actuator=start.actuator,
            plant=start.plant,
            sensor=start.sensor,
            displacement=start.displacement,
            applied=start.voltage,
        )

    def step(self, state: BrokenState, input: ScalarLike) -> tuple[BrokenState, Scalar]:
        loop, reference = self.loop, self.reference + self.reference_push
        sensor, measured = loop.sensor.step(
            state.sensor, (state.displacement, jnp.zeros_like(state.displacement))
        )
        seen = Observation(
            reference, reference, measured, state.applied + self.voltage_push
        )
        controller, command = loop.controller.step(state.controller, seen)
        actuator, applied = loop.actuator.step(state.actuator, command)
        plant, displacement = loop.plant.step(state.plant, input + self.voltage_push)
        state = BrokenState(controller, actuator, plant, sensor, displacement, applied)
        return state, -applied


def broken_loop(
    loop: Feedback,
    reference: ScalarLike = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
) -> BrokenLoop:
    """Return ``loop`` cut at the plant's input, at rest at ``reference`` (um).

    ``state`` is the operating point, by default ``loop.init(reference)``: on the virgin
    loading curve of a plant with hysteresis. There the local gain depends on where the
    voltage goes next, and ``branch`` says where: "ascending" on, "descending" back. All
    kinks, those of an inverse hysteresis in the controller too, are taken on the same
    side, by a push of about 1e-12 V. For a Coleman-Hodgdon model at (x, y) the two
    slopes are b + h and b - h, h = a x + c y: b is their mean, and -a/c, the axis of
    the loop, the limit of b + h far along a branch. For a plant without kinks both
    branches are the same.

    Limits of the voltage (Saturation) are taken out of the actuator, since margins are
    about small motions; slew limits and converters count with their slope at rest, 1. A
    switching term (``BangBang``) has no slope and is left out.

    Raises ValueError for an unknown branch.
    """
    return cut(loop, as_array(reference), side_of(branch), state)


def side_of(branch: str) -> float:
    """Return +1 or -1. Raises ValueError for an unknown branch."""
    if branch not in BRANCHES:
        raise ValueError(f"branch {branch!r}; it must be one of {list(BRANCHES)}")
    return BRANCHES[branch]


def cut(
    loop: Feedback, reference: Scalar, side: ScalarLike, state: LoopState | None
) -> BrokenLoop:
    """Return the loop cut as by ``broken_loop``, ``side`` +1 or -1 for the branch."""
    start = loop.init(reference) if state is None else state
    plain = BrokenLoop(_without_limits(loop), reference, start)
    size = 1.0 + jnp.abs(start.voltage)
    # How far the command follows the reference at once; it may go either way.
    tried = VOLTAGE_PUSH**0.5 * (1.0 + jnp.abs(reference))
    moved = eqx.tree_at(lambda b: b.reference_push, plain, tried)
    rise = (-moved.step(moved.init(), start.voltage)[1] - start.voltage) / tried
    follows = jnp.abs(rise) > VOLTAGE_PUSH
    needed = jnp.where(follows, 1.0, 0.0) / jnp.where(follows, rise, 1.0)
    return BrokenLoop(
        plain.loop,
        reference,
        start,
        voltage_push=jax.lax.stop_gradient(side * VOLTAGE_PUSH * size),
        reference_push=jax.lax.stop_gradient(side * COMMAND_PUSH * size * needed),
    )


def _without_limits(loop: Feedback) -> Feedback:
    def freed(part: Any) -> Any:
        return Affine() if isinstance(part, Saturation) else part

    actuator = jax.tree.map(
        freed, loop.actuator, is_leaf=lambda part: isinstance(part, Saturation)
    )
    return Feedback(loop.controller, loop.plant, actuator, loop.sensor)


def open_loop(
    loop: Feedback,
    reference: ScalarLike = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> StateSpace:
    """Return L, one input and one output, of ``loop`` cut at the plant's input.

    The closed loop is ``A - B C``, since D = 0: a plant answers one sample later.
    ``dt`` in s is looked for in the controller, then in the rest of the loop. Other
    arguments as for ``broken_loop``; usable inside ``jax.jit`` with ``dt`` or without.
    Raises ValueError as ``broken_loop`` and ``linearise``.
    """
    dt = loop_sample_time(loop) if dt is None else dt
    broken = broken_loop(loop, reference, branch, state)
    return linearise(broken, broken.start.voltage, broken.init(), dt)


def loop_sample_time(loop: Feedback) -> float:
    """Return the controller's sample time (s), or that of the rest of the loop.

    A plant may be stepped faster inside (``Held``). Raises ValueError if it is nowhere,
    or not unique.
    """
    try:
        return sample_time(loop.controller)
    except ValueError:
        return sample_time(loop)


def check_operating_point(start: LoopState, reference: float) -> None:
    """Raise ValueError unless ``start`` is finite and rests at ``reference`` (um)."""
    displacement, voltage = float(start.displacement), float(start.voltage)
    far = abs(displacement - reference) > 1e-6 * (1.0 + abs(reference))
    if far or not np.isfinite([displacement, voltage]).all():
        raise ValueError(
            f"the loop cannot rest at {reference:g} um: within the actuator's limits "
            f"the stage rests at {displacement:.6g} um under {voltage:.6g} V; "
            "choose another reference"
        )
