"""Loop cut at the input of its plant, from which margins are computed."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ...core.arrays import ScalarLike, Signal, State, as_signal
from ...core.feedback import Feedback, LoopState, Observation
from ...core.system import Affine, System, resolve
from ...dynamics import StateSpace
from ...dynamics.linearise import linearise
from ...hardware import Quantiser, Saturation
from .operating_point import OperatingPoint

VOLTAGE_PUSH = 2.0**-40
"""Push, a small constant added to voltages, as a share of 1 + |u|: enough to select a
branch, too small to move along it."""

COMMAND_PUSH = 2.0**-30
"""Push on the command, made by a change of the reference, as a share of 1 + |u|. It is
larger than ``VOLTAGE_PUSH``, so that an inverse hysteresis in the controller is on the
same branch."""


class BrokenState(NamedTuple):
    """State of a cut loop; ``applied`` is the actuator's last voltage, V.

    The displacements come before the voltages, and both after all other states.
    """

    controller: State
    actuator: State
    plant: State
    sensor: State
    displacement: Signal
    applied: Signal


class BrokenLoop(System):
    """A Feedback loop cut between its actuator and its plant.

    Input: the voltage injected into the plant, V. Output: minus the voltage that the
    actuator then returns, V. Feeding back minus the output closes the loop, and its
    transfer function L has the critical point -1. With several axes input and output
    are tuples, all axes are cut at once, and L is a matrix.

    The cut lies behind the point at which the controller reads the applied voltage:
    ``applied`` stays the actuator's own last voltage. A disturbance observer therefore
    keeps its inner loop, and L is the plant times the whole response of the controller
    to a measurement. The margins are those against a gain, a phase or a delay of the
    amplifier, the stage or the sensor that is unknown to the controller. (With the cut
    before that point the controller would read the change, and the margins would be
    too large.)

    Use ``broken_loop`` to make one. ``reference`` (um) is constant. The pushes (V, um)
    select a branch where a step has kinks; without them the loop runs unchanged.
    """

    loop: Feedback
    reference: Signal = eqx.field(converter=as_signal)
    start: LoopState
    voltage_push: Signal | None = None
    reference_push: Signal | None = None

    @property
    def rest(self) -> Signal:
        """Input at the operating point."""
        return self.start.voltage

    def init(self, input: Any = None) -> BrokenState:
        """Return the state of the operating point; the input is ignored."""
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
        state = self._stepped(state, input)
        return state, jax.tree.map(jnp.negative, state.applied)

    def closed(
        self,
        state: BrokenState,
        added: Signal,
        moved: tuple[Signal, Signal] | None = None,
    ) -> tuple[BrokenState, Signal]:
        """Step the loop, closed for small motions, with ``added`` (V) at the plant.

        Return the new state and the voltage at the plant. Its value is exactly that of
        the operating point plus ``added``. Its derivatives with respect to the state
        and to ``moved``, the deviations of r(k) and r(k+1) from the reference, are
        those of the actuator's voltage.
        """
        controller, actuator, sensor, applied = self._answer(state, moved)
        acting = jax.tree.map(
            lambda held, new, more: held + (new - jax.lax.stop_gradient(new)) + more,
            self.start.voltage,
            applied,
            added,
        )
        plant, displacement = self._move(state, acting)
        state = BrokenState(controller, actuator, plant, sensor, displacement, applied)
        return state, acting

    def _stepped(
        self,
        state: BrokenState,
        input: Signal,
        moved: tuple[Signal, Signal] | None = None,
    ) -> BrokenState:
        """Return the state after ``input`` at the plant; ``moved`` as in _answer."""
        controller, actuator, sensor, applied = self._answer(state, moved)
        plant, displacement = self._move(state, input)
        return BrokenState(controller, actuator, plant, sensor, displacement, applied)

    def _answer(
        self, state: BrokenState, moved: tuple[Signal, Signal] | None = None
    ) -> tuple[State, State, State, Signal]:
        """Return the states of controller, actuator and sensor, and the voltage.

        ``moved`` holds the deviations of r(k) and r(k+1) from the reference.
        """
        loop, reference = self.loop, _pushed(self.reference, self.reference_push)
        no_noise = jax.tree.map(jnp.zeros_like, state.displacement)
        sensor, measured = loop.sensor.step(
            state.sensor, (state.displacement, no_noise)
        )
        known = _pushed(state.applied, self.voltage_push)
        now, following = (_pushed(reference, by) for by in moved or (None, None))
        observed = Observation(now, following, measured, known)
        controller, command = loop.controller.step(state.controller, observed)
        actuator, applied = loop.actuator.step(state.actuator, command)
        return controller, actuator, sensor, applied

    def _move(self, state: BrokenState, input: Signal) -> tuple[State, Signal]:
        return self.loop.plant.step(state.plant, _pushed(input, self.voltage_push))


class FollowedLoop(BrokenLoop):
    """A BrokenLoop whose reference moves too.

    Input: the voltage injected into the plant, V, and the deviations of r(k) and r(k+1)
    from the reference, um. Output: that of a BrokenLoop, V, and the displacement y(k),
    um.
    """

    @property
    def rest(self) -> Any:
        """Input at the operating point."""
        still = jax.tree.map(jnp.zeros_like, self.reference)
        return self.start.voltage, still, still

    def step(self, state: BrokenState, input: Any) -> tuple[BrokenState, Any]:
        injected, *moved = input
        after = self._stepped(state, injected, tuple(moved))
        return after, (jax.tree.map(jnp.negative, after.applied), state.displacement)


def _pushed(signal: Signal, push: Signal | None) -> Signal:
    return signal if push is None else jax.tree.map(jnp.add, signal, push)


def broken_loop(loop: Feedback, at: Any = 0.0) -> BrokenLoop:
    """Return ``loop`` cut at the plant's input.

    ``at`` is an ``OperatingPoint``, or the reference (um) at which the loop rests. At
    rest the plant is on the virgin loading curve of its hysteresis. There the local
    gain depends on the direction in which the voltage moves next. The ``branch`` of the
    point selects it: "ascending" continues along the curve, "descending" turns back.
    Pushes (``VOLTAGE_PUSH``, ``COMMAND_PUSH``) select the same side of all kinks,
    including those of an inverse hysteresis in the controller. For a Coleman-Hodgdon
    model at (x, y) the two slopes are b + h and b - h, h = a x + c y. Their mean is b.
    Far along a branch, b + h tends to -a/c, the slope of the axis of the hysteresis
    loop. For a plant without kinks both branches are the same.

    Limits (Saturation) and converters (Quantiser) are removed from the actuator and the
    sensor: margins hold for small motions, and no loop rests exactly on the steps of a
    converter. A slew limit has its slope at rest, 1. A switching term (``BangBang``)
    has slope 0 and does not count.
    """
    point = OperatingPoint.at(at)
    return cut(loop, point.signal, point.side, point.state)


def cut(
    loop: Feedback,
    reference: Signal,
    side: ScalarLike,
    state: LoopState | None,
    kind: type[BrokenLoop] = BrokenLoop,
) -> BrokenLoop:
    """Return ``loop`` cut as by ``broken_loop``, as an instance of ``kind``.

    ``side`` is +1 on the ascending branch and -1 on the descending one.
    """
    smooth = _without(resolve(loop), Quantiser)
    start = smooth.init(reference) if state is None else state
    freed = _without(smooth, Saturation)
    # Direct gain from the reference to the command; its sign may be either.
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
    return kind(freed, reference, start, *jax.lax.stop_gradient(pushes))


def _without(loop: Feedback, kind: type[System]) -> Feedback:
    """Return ``loop`` without the parts of this ``kind`` in actuator and sensor."""

    def freed(system: System) -> Any:
        return jax.tree.map(
            lambda part: Affine() if isinstance(part, kind) else part,
            system,
            is_leaf=lambda part: isinstance(part, kind),
        )

    return Feedback(
        loop.controller, loop.plant, freed(loop.actuator), freed(loop.sensor)
    )


def open_loop(loop: Feedback, at: Any = 0.0) -> StateSpace:
    """Return L of ``loop`` cut at the plant's input.

    L has one input and one output for each axis. The closed loop is ``A - B C``, since
    D = 0: a plant responds one sample later. ``at`` as for ``broken_loop``; usable
    inside ``jax.jit``. Raises ValueError as ``loop_sample_time`` and ``linearise`` do.
    """
    point = OperatingPoint.at(at)
    dt = point.sample_time(loop)
    broken = broken_loop(loop, point)
    return linearise(broken, broken.start.voltage, broken.init(), dt)
