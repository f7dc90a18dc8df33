"""The one protocol, System, and its compositions."""

import abc
import dataclasses
from typing import Any, NamedTuple, dataclass_transform

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from .arrays import Scalar, ScalarLike, Signal, State, as_array, as_signal
from .parameter import check_declared, parameter, sample_time


@dataclass_transform(
    field_specifiers=(dataclasses.field, eqx.field, parameter, sample_time)
)
class System(eqx.Module):
    """Anything that runs in time: a plant, a filter, an observer, a controller, a loop.

    Array fields are its parameters: they can be differentiated, batched with
    ``jax.vmap``, tuned by their path or perturbed without knowing what the system is.
    """

    def __check_init__(self):
        check_declared(self)

    @abc.abstractmethod
    def init(self, input: Any = 0.0) -> State:
        """Return the state at rest under the constant ``input``.

        A step with that same input leaves the state where it is.
        """

    @abc.abstractmethod
    def step(self, state: State, input: Any) -> tuple[State, Any]:
        """Advance one sample: ``(state, input) -> (next state, output)``.

        Pure, free of branches, for one signal; batches are ``jax.vmap``'s job.
        """

    def __rshift__(self, other: "System") -> "Series":
        """Return ``self`` followed by ``other``."""
        return Series((*_series_parts(self), *_series_parts(other)))

    def __add__(self, other: "System") -> "Parallel":
        """Return the sum of both systems' outputs for the same input."""
        return Parallel((*_parallel_parts(self), *_parallel_parts(other)))


class Designed(System):
    """A system whose parameters are not the numbers that it steps with.

    ``resolved`` computes those, such as a gain matrix from a model, and returns a
    system with the same state, input and output. ``simulate`` does so once, before the
    loop over time; in the step it would be done, and differentiated, at every sample.
    """

    @abc.abstractmethod
    def resolved(self) -> System:
        """Return the equivalent System to step."""

    def init(self, input: Any = 0.0) -> State:
        return self.resolved().init(input)

    def step(self, state: State, input: Any) -> tuple[State, Any]:
        return self.resolved().step(state, input)


def resolve(system: Any) -> Any:
    """Return ``system`` with every part that is Designed resolved."""

    def is_designed(part: Any) -> bool:
        return isinstance(part, Designed)

    return jax.tree.map(
        lambda part: resolve(part.resolved()) if is_designed(part) else part,
        system,
        is_leaf=is_designed,
    )


class Learned(eqx.Module):
    """State that is learned while a system runs: a loop taken for small motions holds
    it, because what it has learned changes slowly and acts only on larger ones."""


def rest_output(system: System, input: Any) -> Any:
    """Return what ``system`` puts out at rest under the constant ``input``."""
    return system.step(system.init(input), input)[1]


class Series(System):
    """Systems one after the other; ``a >> b >> c`` makes one.

    Parts are reached by their position (``plant.0.a``) or, if ``names`` are given, by
    name (``plant.hysteresis.a``).
    """

    parts: tuple[System, ...]
    names: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        if self.names and len(self.names) != len(self.parts):
            raise ValueError(f"{len(self.parts)} parts but names {self.names}")

    def init(self, input: Any = 0.0) -> State:
        states = []
        for part in self.parts:
            states.append(part.init(input))
            input = part.step(states[-1], input)[1]
        return tuple(states)

    def step(self, state: State, input: Any) -> tuple[State, Any]:
        states = []
        for part, part_state in zip(self.parts, state, strict=True):
            part_state, input = part.step(part_state, input)
            states.append(part_state)
        return tuple(states), input


class Parallel(System):
    """The sum of several systems' outputs for one input; ``a + b`` makes one."""

    parts: tuple[System, ...]

    def init(self, input: Any = 0.0) -> State:
        return tuple(part.init(input) for part in self.parts)

    def step(self, state: State, input: Any) -> tuple[State, Any]:
        stepped = [
            part.step(s, input) for part, s in zip(self.parts, state, strict=True)
        ]
        total = stepped[0][1]
        for _, output in stepped[1:]:
            total = total + output
        return tuple(s for s, _ in stepped), total


def series(**parts: System) -> Series:
    """Return the named parts in series: ``series(hysteresis=..., dynamics=...)``."""
    return Series(tuple(parts.values()), tuple(parts))


def _series_parts(system: System) -> tuple[System, ...]:
    if isinstance(system, Series) and not system.names:
        return system.parts
    return (system,)


def _parallel_parts(system: System) -> tuple[System, ...]:
    return system.parts if isinstance(system, Parallel) else (system,)


class Affine(System):
    """``output = gain * input + offset``: a calibration, a sensor's zero."""

    gain: Scalar = parameter("1", "gain", default=1.0)
    offset: Scalar = parameter("1", "offset", default=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, self.gain * as_array(input) + self.offset


class Delay(System):
    """A pure delay by a whole number of samples."""

    samples: int = parameter(
        "1", "number of samples", least=0.0, whole=True, static=True
    )

    def init(self, input: ScalarLike = 0.0) -> State:
        return (as_array(input),) * self.samples

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        line = (*state, as_array(input))
        return line[1:], line[0]


class Observation(NamedTuple):
    """What a controller sees at sample k: scalars, or tuples of one scalar an axis.

    ``reference`` r(k) and ``next_reference`` r(k+1) in um; ``measured`` z(k) in um;
    ``applied``, the voltage that the actuator was given at k-1, after its limits, in V.
    """

    reference: Signal
    next_reference: Signal
    measured: Signal
    applied: Signal


class LoopInput(NamedTuple):
    """What drives a loop at sample k.

    ``next_reference`` r(k+1) in um; ``noise``, a unit-variance draw that the sensor
    scales; ``disturbance`` in um, if any, moves the displacement itself at k+1.
    """

    next_reference: Signal
    noise: Signal
    disturbance: Signal | None = None


class LoopSample(NamedTuple):
    """What a loop logs at sample k, um and V.

    ``command`` is what the controller asked for, ``voltage`` what the actuator gave.
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
    """A controller around an actuator, a plant and a sensor.

    At sample k the sensor measures y(k), the controller sees r(k), r(k+1) and the
    measurement, the actuator turns its command into u(k), and u(k) moves the plant to
    y(k+1): one sample of delay from input to measured output, so no algebraic loop.

    With several axes every signal is a tuple of scalars, one an axis, in the units of
    its axis; nothing else changes.
    """

    controller: System
    plant: System
    actuator: System
    sensor: System

    def init(self, input: Any = 0.0, holding: Any = None) -> LoopState:
        """Return the loop at rest at the reference ``input`` (um): a bumpless start.

        With several axes ``input`` is a vector or a tuple. ``holding`` is what
        ``holding_input`` gives for it, if known: solving for it takes longer to compile
        than the rest.
        """
        reference = as_signal(input)
        if holding is None:
            holding = holding_input(self.plant, reference)
        voltage = rest_output(self.actuator, as_signal(holding))
        displacement = rest_output(self.plant, voltage)
        quiet = (displacement, jax.tree.map(jnp.zeros_like, displacement))
        measured = rest_output(self.sensor, quiet)
        seen = Observation(reference, reference, measured, voltage)
        return LoopState(
            controller=self.controller.init(seen),
            actuator=self.actuator.init(voltage),
            plant=self.plant.init(voltage),
            sensor=self.sensor.init(quiet),
            reference=reference,
            displacement=displacement,
            voltage=voltage,
        )

    def step(self, state: LoopState, input: LoopInput) -> tuple[LoopState, LoopSample]:
        sensor, measured = self.sensor.step(
            state.sensor, (state.displacement, input.noise)
        )
        seen = Observation(
            state.reference, input.next_reference, measured, state.voltage
        )
        controller, command = self.controller.step(state.controller, seen)
        actuator, voltage = self.actuator.step(state.actuator, command)
        plant, displacement = self.plant.step(state.plant, voltage)
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
) -> LoopInput:
    """Return the inputs that make a loop follow ``reference`` (um).

    ``noise`` holds unit-variance draws, zero if left out; ``disturbance`` (um) is added
    to what the plant does. The last sample is repeated
    as its own successor; what it influences lies after the end of the record. Several
    axes: a column each, in the units of the axis.
    """
    reference = as_array(reference)
    following = jnp.concatenate([reference[1:], reference[-1:]])
    noise = jnp.zeros_like(reference) if noise is None else noise
    return LoopInput(
        _columns(following),
        _columns(noise),
        None if disturbance is None else _columns(disturbance),
    )


def _columns(signal: Array) -> Any:
    if signal.ndim == 1:
        return signal
    return tuple(signal[:, axis] for axis in range(signal.shape[1]))


def holding_input(plant: System, output: Signal) -> Signal:
    """Return the constant input under which ``plant`` rests at ``output``.

    Solved by Newton's method on the loading curve from the plant's own rest point;
    where no input reaches ``output`` the last iterate is returned and the loop starts
    with an error. Limits belong in the loop's actuator, not in the plant: the curve is
    flat behind them. The search starts at 0; with several axes at ``output`` itself,
    because commands are in its unit and a stage with an allocation inside may not reach
    the pose 0, or be on the edge of its reach there.
    """
    output = jax.tree.map(as_array, output)

    def residual(input, _):
        return jax.tree.map(jnp.subtract, rest_output(plant, input), output)

    solver = optx.Newton(rtol=1e-12, atol=1e-12)
    start = output if isinstance(output, tuple) else jnp.zeros_like(output)
    solution = optx.root_find(residual, solver, start, max_steps=64, throw=False)
    return jax.tree.map(
        lambda value: jnp.where(jnp.isfinite(value), value, 0.0), solution.value
    )
