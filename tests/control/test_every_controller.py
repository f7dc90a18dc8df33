"""Every controller of the catalogue satisfies the protocol.

Controllers of the catalogue are checked without an entry here; OTHERS adds others.
"""

import dataclasses
import json
import re
from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from piezojax import Observation, control, simulate
from piezojax.catalog import (
    CONTROLLERS,
    p558,
    p558_actuators,
    p753,
    p753_survey,
)
from piezojax.catalog.p558_control import arx_models
from piezojax.core import registry
from piezojax.core.parameter import declarations, parameter
from piezojax.core.serial import from_data, to_data
from piezojax.core.system import Affine, System, resolve
from piezojax.dynamics import FirstOrderLag, SecondOrderLowPass, observability_form

SAMPLES = 8
STEP = 1e-6
"""Relative change of a parameter for its difference quotient."""

MOST = 24
"""Largest number of parameters of a controller that are changed."""

QUICK = {"xla_backend_optimization_level": 0}
"""Options of the compiler for programs that run once: compile quickly."""

DT = p753.DT


class Leaking(System):
    """A controller from outside the package: a leaky integral and a share."""

    gain: jax.Array = parameter("V/um", "gain", least=0.0)
    leak: jax.Array = parameter("1", "share that is left", least=0.0, below=1.0)

    def init(self, input):
        return input.applied, jnp.zeros_like(input.applied)

    def step(self, state, seen):
        rest, integral = state
        integral = self.leak * integral + seen.next_reference - seen.measured
        return (rest, integral), rest + self.gain * integral


EXTRA = {
    "from outside": lambda: Leaking(0.3, 0.9),
    "weighted pid": lambda: control.PID(
        0.5, 3000.0, 1e-5, 1e-4, 100.0, 3.0, -2.5, dt=DT
    ),
    "active damping": lambda: control.ActiveDamping(
        p753.pid(), SecondOrderLowPass(2000.0, 0.3, DT), 0.4
    ),
    "guarded pid": lambda: control.Guard(
        p753.pid(), -20.0, 120.0, 1e5, 5.0, 0.0, 20, 2.0, DT
    ),
    "repetitive, short": lambda: control.RepetitiveControl(
        p753.sliding_mode(), FirstOrderLag(4 * DT, DT), 0.2, 3
    ),
}
"""Controllers that the catalogue lacks, such as those with other options."""

STARTS = CONTROLLERS | EXTRA

COSTLY = (
    "mirror_multi_axis",
    "p558_multi_axis",
    "p558_anticipating_multi_axis",
    "p558_anticipating_disturbance_observer",
    "p558_state_sliding_mode",
    "p558_anticipating_state_sliding_mode",
    "mirror_state_sliding_mode",
)
"""Controllers whose program takes a minute to compile; they have separate tests."""

RUN = [name for name in STARTS if name not in COSTLY]


@cache
def made(name):
    return STARTS[name]()


# Holding voltages of a stage, from the model of the stage in the controller.

POSE = (5.0, 10.0, -20.0)


def by_axis():
    gains = [sum(m.moving) / (1.0 - sum(m.autoregressive)) for m in arx_models()]
    return tuple(np.divide(POSE, gains))


def by_model():
    gain = observability_form(p558.model("7")).dc_gain()
    return tuple(np.linalg.solve(np.asarray(gain), POSE))


@cache
def rest_of(name):
    """Return reference and voltage at which the stage of the controller rests."""
    if not name.startswith("p558"):
        return 5.0, 40.0
    if name.endswith(("nominal", "disturbance_observer")):
        return POSE, by_axis()
    return POSE, by_model()


def observations(name, moving, seed=7):
    """Return the inputs of a controller from rest on, an array or one array per axis.

    With ``moving`` 0 the signals are constant.
    """
    random = np.random.default_rng(seed)

    def signals(reference, voltage):
        ramp = reference + moving * 0.05 * np.arange(SAMPLES + 1)
        measured, applied = (
            value + moving * 0.01 * random.normal(size=SAMPLES)
            for value in (reference, voltage)
        )
        return Observation(*map(jnp.asarray, (ramp[:-1], ramp[1:], measured, applied)))

    reference, voltage = rest_of(name)
    if isinstance(reference, float):
        return signals(reference, voltage)
    return Observation(*zip(*map(signals, reference, voltage), strict=True))


def at(seen, k):
    return jax.tree.map(lambda signal: signal[k], seen)


def stacked(commands):
    return jnp.stack(commands) if isinstance(commands, tuple) else commands


class Runs(NamedTuple):
    """Commands of a controller in motion, with changed gains, and at rest.

    ``found`` is the gradient by relative changes, ``expected`` its differences.
    """

    changed: System
    commands: np.ndarray
    gradients: np.ndarray
    found: np.ndarray
    expected: np.ndarray
    traces: int


@cache
def runs(name):
    """Return the results of one program for all lanes, called twice."""
    arrays, static = eqx.partition(made(name), eqx.is_array)
    flat, unravel = ravel_pytree(arrays)
    flat, traces = np.asarray(flat), []

    def loss(values, seen):
        traces.append(name)
        controller = eqx.combine(unravel(values), static)
        first = controller.init(at(seen, 0))
        commands = simulate(controller, seen, first, segment=SAMPLES)[1]
        commands = stacked(commands)
        return jnp.sum(jnp.cos(jnp.arange(commands.size)) * commands.ravel()), commands

    slopes = jax.value_and_grad(loss, has_aux=True)
    program = jax.jit(jax.vmap(slopes), compiler_options=QUICK)
    size = np.where(flat == 0.0, 1e-4, np.abs(flat))
    some = np.unique(np.linspace(0, flat.size - 1, MOST).astype(int))
    moves = STEP * np.diag(size)[some]
    lanes = np.vstack([flat, 1.01 * flat, flat, flat + moves, flat - moves])
    moving, resting = observations(name, 1.0), observations(name, 0.0)
    signals = jax.tree.map(
        lambda moved, rest: np.stack([moved, moved, rest] + 2 * some.size * [moved]),
        moving,
        resting,
    )
    # Every operation on an array of JAX would be a program of its own.
    (losses, commands), gradients = jax.tree.map(np.asarray, program(lanes, signals))
    program(1.001 * lanes, signals)
    upper, lower = np.split(losses[3:], 2)
    return Runs(
        changed=eqx.combine(jax.jit(unravel)(1.01 * flat), static),
        commands=commands[:3],
        gradients=gradients,
        found=(gradients[0] * size)[some],
        expected=(upper - lower) / (2.0 * STEP),
        traces=len(traces),
    )


@pytest.mark.parametrize("name", RUN)
def test_a_start_at_rest_is_bumpless_and_stays_at_rest(name):
    commands = runs(name).commands[2]
    expected = np.broadcast_to(np.asarray(rest_of(name)[1])[..., None], commands.shape)
    np.testing.assert_allclose(commands, expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", RUN)
def test_compiled_lanes_equal_eager_steps(name):
    found, seen = runs(name), observations(name, 1.0)
    controller, state = resolve(found.changed), found.changed.init(at(seen, 0))
    for k in range(3):
        state, command = controller.step(state, at(seen, k))
        np.testing.assert_allclose(
            found.commands[1][..., k], stacked(command), rtol=1e-8, atol=1e-9
        )
    assert found.traces == 1  # New gains do not compile another program.


@pytest.mark.parametrize("name", RUN)
def test_the_gradient_equals_finite_differences(name):
    found = runs(name)
    assert np.all(np.isfinite(found.gradients))
    floor = 1e-7 * np.sum(np.abs(found.commands[0]))
    np.testing.assert_allclose(found.found, found.expected, rtol=1e-3, atol=floor)


@pytest.mark.parametrize("name", STARTS)
def test_a_controller_is_saved_and_loaded(name, monkeypatch):
    registry.kinds()
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    registry.register(Leaking)
    text = json.dumps(to_data(made(name)))
    assert eqx.tree_equal(from_data(json.loads(text)), made(name))


# Refused values

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
    for value in wrong(
        declared.at(example.dt)
        if declared.below_nyquist and not declared.switched
        else declared
    )
]


@pytest.mark.parametrize(("example", "name", "value"), REFUSALS)
def test_a_refused_value_is_named(example, name, value):
    before = getattr(example, name)
    after = jax.tree.map(
        lambda one: np.full(np.shape(one), value) if np.shape(one) else value, before
    )
    with pytest.raises((ValueError, TypeError), match=rf"\b{re.escape(name)}\b"):
        dataclasses.replace(example, **{name: after})
