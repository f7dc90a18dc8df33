"""A loop cut at the input of its plant: what margins are about."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...core.arrays import ScalarLike, Signal, State, as_signal
from ...core.system import Affine, Feedback, LoopState, Observation, System
from ...dynamics import StateSpace
from ...dynamics.linearise import linearise, sample_time
from ...hardware import Saturation

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
    displacement: Signal
    applied: Signal


class BrokenLoop(System):
    """A Feedback loop cut between its actuator and its plant.

    Input: the voltage injected into the plant, V. Output: minus the voltage that the
    actuator then returns, V, so that the loop is closed by feeding back minus the
    output, and its transfer function L has the critical point -1. With several axes
    both are tuples, all axes are cut at once, and L is a matrix.

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
    reference: Signal = eqx.field(converter=as_signal)
    start: LoopState
    voltage_push: Signal | None = None
    reference_push: Signal | None = None

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

    def step(self, state: BrokenState, input: Signal) -> tuple[BrokenState, Signal]:
        loop, reference = self.loop, _pushed(self.reference, self.reference_push)
        quiet = jax.tree.map(jnp.zeros_like, state.displacement)
        sensor, measured = loop.sensor.step(state.sensor, (state.displacement, quiet))
        known = _pushed(state.applied, self.voltage_push)
        seen = Observation(reference, reference, measured, known)
        controller, command = loop.controller.step(state.controller, seen)
        actuator, applied = loop.actuator.step(state.actuator, command)
        plant, displacement = loop.plant.step(
            state.plant, _pushed(input, self.voltage_push)
        )
        state = BrokenState(controller, actuator, plant, sensor, displacement, applied)
        return state, jax.tree.map(jnp.negative, applied)


def _pushed(signal: Signal, push: Signal | None) -> Signal:
    return signal if push is None else jax.tree.map(jnp.add, signal, push)


def broken_loop(
    loop: Feedback,
    reference: Any = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
) -> BrokenLoop:
    """Return ``loop`` cut at the plant's input, at rest at ``reference`` (um).

    With several axes ``reference`` is a vector or a tuple, in the units of the axes.

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
    return cut(loop, as_signal(reference), side_of(branch), state)


def side_of(branch: str) -> float:
    """Return +1 or -1. Raises ValueError for an unknown branch."""
    if branch not in BRANCHES:
        raise ValueError(f"branch {branch!r}; it must be one of {list(BRANCHES)}")
    return BRANCHES[branch]


def cut(
    loop: Feedback, reference: Signal, side: ScalarLike, state: LoopState | None
) -> BrokenLoop:
    """Return the loop cut as by ``broken_loop``, ``side`` +1 or -1 for the branch."""
    start = loop.init(reference) if state is None else state
    freed = _without_limits(loop)
    # How far the command follows the reference at once; it may go either way.
    tried = jax.tree.map(lambda r: VOLTAGE_PUSH**0.5 * (1.0 + jnp.abs(r)), reference)
    moved = BrokenLoop(freed, reference, start, reference_push=tried)
    _, output = moved.step(moved.init(), start.voltage)

    def voltage_push(voltage):
        return side * VOLTAGE_PUSH * (1.0 + jnp.abs(voltage))

    def reference_push(output, voltage, tried):
        rise = (-output - voltage) / tried
        follows = jnp.abs(rise) > VOLTAGE_PUSH
        needed = jnp.where(follows, 1.0, 0.0) / jnp.where(follows, rise, 1.0)
        return side * COMMAND_PUSH * (1.0 + jnp.abs(voltage)) * needed

    pushes = (
        jax.tree.map(voltage_push, start.voltage),
        jax.tree.map(reference_push, output, start.voltage, tried),
    )
    return BrokenLoop(freed, reference, start, *jax.lax.stop_gradient(pushes))


def _without_limits(loop: Feedback) -> Feedback:
    def freed(part: Any) -> Any:
        return Affine() if isinstance(part, Saturation) else part

    actuator = jax.tree.map(
        freed, loop.actuator, is_leaf=lambda part: isinstance(part, Saturation)
    )
    return Feedback(loop.controller, loop.plant, actuator, loop.sensor)


def open_loop(
    loop: Feedback,
    reference: Any = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> StateSpace:
    """Return L of ``loop`` cut at the plant's input: an input and an output an axis.

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


def check_operating_point(start: LoopState, reference: Any) -> None:
    """Raise ValueError unless ``start`` is finite and rests at ``reference`` (um)."""
    wanted, reached, held = (
        np.ravel(np.asarray(jax.tree.leaves(signal), float))
        for signal in (as_signal(reference), start.displacement, start.voltage)
    )
    far = np.abs(reached - wanted) > 1e-6 * (1.0 + np.abs(wanted))
    wrong = far | ~np.isfinite(reached) | ~np.isfinite(held)
    if not wrong.any():
        return
    shown = [
        ", ".join(f"{number:{form}}" for number in values)
        for values, form in ((wanted, "g"), (reached, ".6g"), (held, ".6g"))
    ]
    raise ValueError(
        f"the loop cannot rest at {shown[0]} um: within the actuator's limits "
        f"the stage rests at {shown[1]} um under {shown[2]} V; "
        "choose another reference"
    )
