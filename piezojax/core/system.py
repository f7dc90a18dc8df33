"""The System protocol and the compositions of systems."""

import abc
import dataclasses
from typing import Any, ClassVar, dataclass_transform

import equinox as eqx
import jax
import jax.numpy as jnp

from .arrays import Scalar, ScalarLike, State, as_array
from .parameter import PartUnits, check_declared, parameter, sample_time


@dataclass_transform(
    field_specifiers=(dataclasses.field, eqx.field, parameter, sample_time)
)
class System(eqx.Module):
    """Discrete-time system: a plant, a filter, an observer, a controller or a loop.

    Its array fields are its parameters. They can be differentiated, batched with
    ``jax.vmap``, and tuned or perturbed by path in any System.
    """

    part_units: ClassVar[PartUnits] = {}
    """Units that replace the names in brackets in the units that each part declares.

    ``{"law": {"s": "um/s", "v": "[u]"}}`` for a field ``law`` with a gain in "[v]/[s]".
    They hold at all depths unless an inner System replaces them.
    """

    def __check_init__(self):
        check_declared(self)

    @abc.abstractmethod
    def init(self, input: Any = 0.0) -> State:
        """Return the state at rest under the constant ``input``.

        A step with the same input does not change this state.
        """

    @abc.abstractmethod
    def step(self, state: State, input: Any) -> tuple[State, Any]:
        """Advance one sample: ``(state, input) -> (next state, output)``.

        The function is pure and free of branches and takes one signal; batch it with
        ``jax.vmap``.
        """

    def __rshift__(self, other: "System") -> "Series":
        """Return ``self`` followed by ``other``."""
        return Series((*_series_parts(self), *_series_parts(other)))

    def __add__(self, other: "System") -> "Parallel":
        """Return the System that sums the outputs of both for the same input."""
        return Parallel((*_parallel_parts(self), *_parallel_parts(other)))


class Designed(System):
    """System that steps with numbers computed from its parameters.

    ``resolved`` computes these numbers, such as a gain matrix from a model, and returns
    a System with the same state, input and output. ``simulate`` calls it once, before
    the loop over time; in the step they would be recomputed and differentiated at every
    sample.
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
    return jax.tree.map(
        lambda part: resolve(part.resolved()) if isinstance(part, Designed) else part,
        system,
        is_leaf=lambda part: isinstance(part, Designed),
    )


class Learned(eqx.Module):
    """State that a system learns while it runs.

    ``linearise`` holds it constant, because it changes slowly and acts only on larger
    motions.
    """


def at_rest(system: System, input: Any) -> tuple[State, Any]:
    """Return state and output of ``system`` at rest under the constant ``input``."""
    system = resolve(system)
    state = system.init(input)
    return state, system.step(state, input)[1]


def rest_output(system: System, input: Any) -> Any:
    """Return the output of ``system`` at rest under the constant ``input``."""
    return at_rest(system, input)[1]


def accepts(system: System, example: Any) -> bool:
    """Return whether ``system`` accepts ``example`` as its input, without computing."""
    try:
        eqx.filter_eval_shape(rest_output, system, example)
    except (AttributeError, TypeError, ValueError, IndexError):
        return False
    return True


class Series(System):
    """Systems in series; ``a >> b >> c`` creates one.

    Paths contain the position of a part (``plant.0.a``) or, if ``names`` are given, its
    name (``plant.hysteresis.a``). Raises ValueError if ``names`` and ``parts`` differ
    in length.
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
    """Sum of the outputs of several systems for one input; ``a + b`` creates one."""

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
    """``output = gain * input + offset``: a calibration or the offset of a sensor."""

    gain: Scalar = parameter("1", "gain", default=1.0)
    offset: Scalar = parameter("1", "offset", default=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, self.gain * as_array(input) + self.offset


class Delay(System):
    """Delay by a whole number of samples, at most 1000."""

    samples: int = parameter(
        "1", "number of samples", least=0.0, most=1000.0, whole=True, static=True
    )

    def init(self, input: ScalarLike = 0.0) -> State:
        value = as_array(input)
        # The compile time of separate scalars rises with the cube of their number.
        if self.samples > _SCALARS:
            return jnp.broadcast_to(value, self.samples)
        return (value,) * self.samples

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        if self.samples > _SCALARS:
            return jnp.append(state[1:], input), state[0]
        line = (*state, as_array(input))
        return line[1:], line[0]


_SCALARS = 16
"""Longest Delay whose state is a tuple of scalars, the fastest in a batch."""
