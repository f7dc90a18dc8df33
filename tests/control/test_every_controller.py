"""The protocol of every controller of the catalogue and of every exported class."""

import dataclasses
import inspect
import json
import re
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from piezojax import Observation, control, simulate
from piezojax.catalog import CONTROLLERS, p558_actuators, p753_survey
from piezojax.core.parameter import declarations
from piezojax.core.serial import from_data, to_data
from piezojax.core.system import Affine, System

SAMPLES = 8
STEP = 1e-6
"""Change of a parameter for its difference quotient, relative."""

ONE_AXIS = [name for name in CONTROLLERS if not name.startswith(("p558", "mirror"))]
"""Controllers of several axes hold only the rest of their own stage: their starts,
gradients and compiled steps have tests with that stage."""


@cache
def made(name):
    return CONTROLLERS[name]()


def observations(moving):
    """Return what a controller sees from a rest on: at rest, or while it moves."""
    random = np.random.default_rng(7)
    rest = np.full(SAMPLES + 1, 5.0)
    reference = rest + moving * 0.05 * np.arange(SAMPLES + 1)
    measured, applied = (
        value + moving * 0.01 * random.normal(size=SAMPLES)
        for value in (rest[1:], 8.0 * rest[1:])
    )
    return Observation(
        *map(jnp.asarray, (reference[:-1], reference[1:], measured, applied))
    )


def at(seen, k):
    return jax.tree.map(lambda signal: signal[k], seen)


def eager(controller, seen):
    state, commands = controller.init(at(seen, 0)), []
    for k in range(SAMPLES):
        state, command = controller.step(state, at(seen, k))
        commands.append(command)
    return np.stack(commands)


@cache
def program(name):
    """Return parameters and one compiled program: commands and gradients by lane."""
    arrays, static = eqx.partition(made(name), eqx.is_array)
    flat, unravel = ravel_pytree(arrays)
    traces = []

    def loss(values, seen):
        traces.append(name)
        controller = eqx.combine(unravel(values), static)
        commands = simulate(controller, seen, controller.init(at(seen, 0)))[1]
        return jnp.sum(jnp.cos(jnp.arange(SAMPLES)) * commands), commands

    lanes = jax.vmap(jax.value_and_grad(loss, has_aux=True), in_axes=(0, None))
    return np.asarray(flat), unravel, static, jax.jit(lanes), traces


@pytest.mark.parametrize("name", ONE_AXIS)
def test_a_start_at_rest_is_bumpless_and_stays(name):
    commands = eager(made(name), observations(moving=False))
    np.testing.assert_allclose(commands, 40.0, rtol=0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ONE_AXIS)
def test_compiled_lanes_are_eager_steps_and_gradients_those_of_differences(name):
    seen = observations(moving=True)
    flat, unravel, static, lanes, traces = program(name)
    size = np.where(flat == 0.0, 1e-4, np.abs(flat))
    moves = STEP * np.diag(size)
    (losses, commands), gradients = lanes(
        np.vstack([flat, flat + moves, flat - moves]), seen
    )
    for lane in (0, 1):
        values = np.vstack([flat, flat + moves])[lane]
        expected = eager(eqx.combine(unravel(values), static), seen)
        np.testing.assert_allclose(commands[lane], expected, rtol=1e-8, atol=1e-9)
    gradient = gradients[0] * size
    assert np.all(np.isfinite(gradients))
    upper, lower = np.split(np.asarray(losses[1:]), 2)
    floor = 1e-7 * np.sum(np.abs(commands[0]))
    np.testing.assert_allclose(
        gradient, (upper - lower) / (2.0 * STEP), rtol=1e-3, atol=floor
    )
    # New gains run in the same program.
    lanes(np.vstack([1.01 * flat, flat + moves, flat - moves]), seen)
    assert len(traces) == 1


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_saved_controller_comes_back(name):
    text = json.dumps(to_data(made(name)))
    assert eqx.tree_equal(from_data(json.loads(text)), made(name))


# Refusals

OTHERS = (
    control.InverseGain(Affine(2.0)),
    p753_survey.learning(),
    p558_actuators.allocation(),
)


def _is_part(node):
    return isinstance(node, eqx.Module)


def parts(node):
    """Yield ``node`` and every module inside it."""
    yield node
    for field in dataclasses.fields(node):
        value = getattr(node, field.name)
        for part in jax.tree.leaves(value, is_leaf=_is_part):
            if _is_part(part):
                yield from parts(part)


@cache
def examples():
    """Return an instance of every class of the package's controllers, by its name."""
    found = {}
    for whole in (*map(made, CONTROLLERS), *OTHERS):
        for part in parts(whole):
            if type(part).__module__.startswith(control.__name__):
                found.setdefault(type(part).__name__, part)
    return found


def wrong(declared):
    """Yield values that the declaration does not allow."""
    yield 1.5 if declared.whole else np.nan
    for limit, beyond in (
        (declared.above, declared.above),
        (declared.least, declared.least - 1),
        (declared.below, declared.below),
        (declared.most, declared.most + 1),
    ):
        if np.isfinite(limit):
            yield int(beyond) if declared.whole else float(beyond)


REFUSALS = [
    pytest.param(example, name, value, id=f"{kind}.{name}={value:g}")
    for kind, example in examples().items()
    for name, declared in declarations(type(example))
    for value in wrong(declared.at(example.dt) if declared.below_nyquist else declared)
]


@pytest.mark.parametrize(("example", "name", "value"), REFUSALS)
def test_a_value_that_is_not_allowed_is_refused_by_name(example, name, value):
    before = getattr(example, name)
    after = jax.tree.map(
        lambda one: np.full(np.shape(one), value) if np.shape(one) else value, before
    )
    with pytest.raises((ValueError, TypeError), match=rf"\b{re.escape(name)}\b"):
        dataclasses.replace(example, **{name: after})


def test_every_exported_class_has_an_example():
    exported = {
        name
        for name, value in vars(control).items()
        if isinstance(value, type)
        and issubclass(value, System)
        and not inspect.isabstract(value)
    }
    assert exported <= set(examples())
