"""The feedback loop, its signals, and its start at rest."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .arrays import Signal, State, as_array, as_signal
from .parameter import PartUnits
from .root import root
from .system import System, at_rest, resolve, rest_output


class Observation(NamedTuple):
    """Input of a controller at sample k: scalars, or tuples with one scalar per axis.

    ``reference`` r(k), ``next_reference`` r(k+1) and ``measured`` z(k) are in um;
    ``applied`` is the voltage of the actuator at k-1, after its limits, in V.
    """

    reference: Signal
    next_reference: Signal
    measured: Signal
    applied: Signal


class LoopInput(NamedTuple):
    """Input of a loop at sample k.

    ``next_reference`` is r(k+1) in um, ``noise`` a unit-variance draw that the sensor
    scales. ``disturbance`` (um) is added to the displacement at k+1, and
    ``input_disturbance`` (V) to the voltage at the plant, unknown to the controller;
    both are optional.
    """

    next_reference: Signal
    noise: Signal
    disturbance: Signal | None = None
    input_disturbance: Signal | None = None


class LoopSample(NamedTuple):
    """Output of a loop at sample k, in um and V.

    ``command`` is the output of the controller, ``voltage`` that of the actuator.
    """

    reference: Signal
    displacement: Signal
    measured: Signal
    command: Signal
    voltage: Signal


class LoopState(NamedTuple):
    """State of a Feedback loop between two samples."""

    controller: State
    actuator: State
    plant: State
    sensor: State
    reference: Signal
    displacement: Signal
    voltage: Signal


class Feedback(System):
    """Feedback loop of a controller, an actuator, a plant and a sensor.

    At sample k the sensor measures y(k), the controller receives r(k), r(k+1) and the
    measurement, the actuator turns the command into u(k), and u(k) moves the plant to
    y(k+1). The measured output lags the input by one sample, so that there is no
    algebraic loop.

    With several axes every signal is a tuple with one scalar per axis, in the unit of
    the axis.
    """

    part_units: ClassVar[PartUnits] = {"controller": {"u": "V"}}

    controller: System
    plant: System
    actuator: System
    sensor: System

    def init(self, input: Any = 0.0, holding: Any = None) -> LoopState:
        """Return the state at rest at the reference ``input`` (um): a bumpless start.

        With several axes ``input`` is a vector or a tuple. ``holding`` is the result of
        ``holding_input`` for this reference. Pass it if it is known: its solver takes
        longer to compile than the rest.
        """
        reference = as_signal(input)
        if holding is None:
            holding = holding_input(self.plant, reference)
        actuator = resolve(self.actuator)
        voltage = rest_output(actuator, as_signal(holding))
        plant, displacement = at_rest(self.plant, voltage)
        quiet = (displacement, jax.tree.map(jnp.zeros_like, displacement))
        sensor, measured = at_rest(self.sensor, quiet)
        observation = Observation(reference, reference, measured, voltage)
        return LoopState(
            controller=resolve(self.controller).init(observation),
            actuator=actuator.init(voltage),
            plant=plant,
            sensor=sensor,
            reference=reference,
            displacement=displacement,
            voltage=voltage,
        )

    def step(self, state: LoopState, input: LoopInput) -> tuple[LoopState, LoopSample]:
        sensor, measured = self.sensor.step(
            state.sensor, (state.displacement, input.noise)
        )
        observation = Observation(
            state.reference, input.next_reference, measured, state.voltage
        )
        controller, command = self.controller.step(state.controller, observation)
        actuator, voltage = self.actuator.step(state.actuator, command)
        at_plant = voltage
        if input.input_disturbance is not None:
            at_plant = jax.tree.map(jnp.add, voltage, input.input_disturbance)
        plant, displacement = self.plant.step(state.plant, at_plant)
        if input.disturbance is not None:
            displacement = jax.tree.map(jnp.add, displacement, input.disturbance)
        sample = LoopSample(
            state.reference, state.displacement, measured, command, voltage
        )
        state = LoopState(
            controller,
            actuator,
            plant,
            sensor,
            jax.tree.map(as_array, input.next_reference),
            displacement,
            voltage,
        )
        return state, sample


def loop_inputs(
    reference: Float[Array, " samples"] | Float[Array, "samples axes"],
    noise: Float[Array, " samples"] | Float[Array, "samples axes"] | None = None,
    disturbance: Float[Array, " samples"] | Float[Array, "samples axes"] | None = None,
    input_disturbance: Float[Array, " samples"]
    | Float[Array, "samples axes"]
    | None = None,
) -> LoopInput:
    """Return the inputs of a loop that follows ``reference`` (um).

    ``noise`` holds unit-variance draws, zero if left out; ``disturbance`` (um) is added
    to the output of the plant, ``input_disturbance`` (V) to its input. The last
    reference is also the next reference of the last sample, but this acts only after
    the end of the run. Several axes are columns, each in the unit of its axis.
    """
    reference = as_array(reference)
    following = _following(reference)
    noise = jnp.zeros_like(reference) if noise is None else noise
    return LoopInput(
        _columns(following),
        _columns(noise),
        None if disturbance is None else _columns(disturbance),
        None if input_disturbance is None else _columns(input_disturbance),
    )


@jax.jit
def _following(reference: Array) -> Array:
    return jnp.concatenate([reference[1:], reference[-1:]])


def _columns(signal: Array) -> Any:
    if signal.ndim == 1:
        return signal
    return tuple(signal[:, axis] for axis in range(signal.shape[1]))


def holding_input(plant: System, output: Signal) -> Signal:
    """Return the constant input under which ``plant`` rests at ``output``.

    Newton's method is applied to the loading curve from the rest point of the plant. If
    no input reaches ``output``, the last iterate is returned, or 0 if it is not finite,
    and the loop starts with an error. Limits belong to the actuator of the loop, not to
    the plant, because the curve is flat beyond them. The iteration starts at 0. With
    several axes it starts at ``output``, because a command is then a pose, and the pose
    0 may be outside, or on the edge of, the range of a stage with an allocation.
    """
    return _holding_input(plant, jax.tree.map(as_array, output))


# Traced once for all plants of a structure, because it takes longer than a run.
@eqx.filter_jit
def _holding_input(plant: System, output: Signal) -> Signal:
    wanted, signal = ravel_pytree(output)
    arrays, static = eqx.partition(plant, eqx.is_array)

    def missed(given: tuple, input: Array) -> Array:
        arrays, wanted = given
        found = rest_output(eqx.combine(arrays, static), signal(input))
        return ravel_pytree(found)[0] - wanted

    start = wanted if isinstance(output, tuple) else jnp.zeros_like(wanted)
    found = root(missed, (arrays, wanted), start)
    return signal(jnp.where(jnp.isfinite(found), found, 0.0))
