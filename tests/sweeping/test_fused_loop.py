"""Many lanes in one kernel, computed without a GPU, against the loop of simulate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from piezojax.catalog import p753
from piezojax.core.arrays import as_array
from piezojax.core.feedback import Feedback, LoopInput
from piezojax.core.metrics import Tracking
from piezojax.core.paths import replace
from piezojax.core.rollout import Metric
from piezojax.core.system import Affine, Delay, System
from piezojax.dynamics import FirstOrderLag
from piezojax.hardware import Quantiser, Saturation, Sensor
from piezojax.hysteresis import PrandtlIshlinskii
from piezojax.sweeping import fused_loop, simulate_lanes
from piezojax.sweeping.simulator import Simulator

SAMPLES = 12

DROPPING = ("max", "min", "clamp")
"""Operations that drop NaN in a kernel of a GPU, but not when it is interpreted."""


class Means(Metric):
    """The means of the output and of its square, from sample 2 on."""

    def init(self):
        return jnp.zeros(2), jnp.zeros((), jnp.int32)

    def update(self, total, index, output):
        sums, count = total
        counted = index >= 2
        more = jnp.stack([output, output**2])
        return sums + jnp.where(counted, more, 0.0), count + counted

    def result(self, total):
        return total[0] / total[1]


class Everything(System):
    """Every operation of a kernel, on the input and a state of each type."""

    gain: jax.Array

    def init(self, input=0.0):
        return as_array(0.3), jnp.zeros((), int), jnp.zeros((), bool)

    def step(self, state, input):
        x, count, above = state
        x, count = 0.5 * x + self.gain * input, count + 3
        unit = jnp.clip(x, -0.9, 0.9)
        values = [
            *(jnp.abs(x), jnp.arccos(unit), jnp.arcsin(unit), jnp.arctan(x)),
            *(jnp.arctan2(x, 0.3), jnp.ceil(x), jnp.cos(x), jnp.cosh(x), 1.0 / (x + 9)),
            *(jnp.exp(x), jnp.expm1(x), jnp.floor(x), jnp.log(x + 9), jnp.log1p(x + 9)),
            *(jax.nn.sigmoid(x), jnp.maximum(x, 0.2), jnp.minimum(x, 0.1), -x),
            *((x + 9) ** 1.7, x**3, x**-2, jax.lax.rem(x, 0.7), jax.lax.rsqrt(x + 9)),
            *(jnp.sign(x), jnp.sin(x), jnp.sinh(x), jnp.sqrt(x + 9), jnp.square(x)),
            *(jnp.tan(x), jnp.tanh(x), jnp.round(4.0 * x), (x > 0.1) ^ above),
            *(~above, (x > 0.1) | above, (x <= 0.3) & (x >= -0.3), x == 0.0, x != 0.0),
            *(jnp.where(x < 0.1, x, 7.0), jnp.isfinite(x), count % 5, count),
            jax.lax.round(4.0 * x, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
        ]
        total = sum(i * as_array(value) for i, value in enumerate(values, 1))
        return (x, count, x > 0.0), total


def primitives(jaxpr):
    """Yield the names of the operations of a jaxpr and of those inside it."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in equation.params.values():
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from primitives(inner)


def kernel_of(program, *arguments):
    """Return the jaxpr of the kernel in a program."""
    (call,) = [
        equation
        for equation in jax.make_jaxpr(program)(*arguments).jaxpr.eqns
        if equation.primitive.name == "pallas_call"
    ]
    return call.params["jaxpr"]


def driven(amplitude=60.0):
    rng = np.random.default_rng(3)
    return jnp.array(amplitude * rng.uniform(0.0, 1.0, SAMPLES))


def loop_inputs():
    rng = np.random.default_rng(5)
    steps = jnp.array(np.repeat(rng.uniform(0.0, 5.0, SAMPLES // 3), 3))
    return LoopInput(steps, jnp.array(rng.standard_normal(SAMPLES)))


def both(system, path, lanes, inputs, metric, start=0.0, scale=1.0):
    """Return the results of one kernel and of the loop of simulate, leaf by leaf.

    The lanes differ in the parameter ``path``. Fails unless the kernel is used.
    """
    values = scale * jnp.linspace(0.5, 1.5, lanes)

    def run_of(value):
        changed = replace(system, {path: value})
        return changed, changed.init(start)

    def simulated(values, **options):
        return simulate_lanes(run_of, values, inputs, metric, **options)

    names = {*primitives(kernel_of(lambda v: simulated(v, fused=True), values))}
    assert names.isdisjoint(DROPPING)
    kernel = jax.jit(lambda v: simulated(v, fused=True, interpret=True))
    plain = jax.jit(lambda v: simulated(v, fused=False))(values)
    return jax.tree.leaves(kernel(values)), jax.tree.leaves(plain)


def assert_equal(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)


def test_every_operation():
    found, expected = both(
        Everything(as_array(1.0)), "gain", 5, driven(2.0) - 1.0, Means()
    )
    assert_equal(found, expected)
    assert np.ptp(np.asarray(found[0])[:, 0]) > 1.0  # the lanes differ


@pytest.mark.parametrize("lanes", [1, 64, 65, 130])
def test_any_number_of_lanes(lanes):
    system = FirstOrderLag(1e-3, 1e-4) >> Affine(1.0, 0.3)
    found, expected = both(system, "1.gain", lanes, driven(), Means())
    assert found[0].shape == (lanes, 2)
    assert_equal(found, expected)


def test_a_system_without_state_or_numbers():
    def simulated(values, **options):
        def run_of(value):
            return Delay(2), Delay(2).init(value)

        return simulate_lanes(run_of, values, driven(), Means(), **options)

    values = jnp.array([0.5, 1.0])
    assert_equal(
        [simulated(values, fused=True, interpret=True)],
        [simulated(values, fused=False)],
    )


LOOPS = {
    "observer": (p753.disturbance_observer(), p753.plant(), Sensor(0.01)),
    "plays, delay and converter": (
        p753.pid(),
        PrandtlIshlinskii(
            polynomial=[0.0, 0.1], thresholds=[2.0, 5.0], weights=[0.02, 0.01]
        )
        >> Delay(2)
        >> FirstOrderLag(3e-4, p753.DT),
        Sensor(0.01) >> Quantiser(0.002),
    ),
}


@pytest.mark.parametrize("in_registers", [True, False])
@pytest.mark.parametrize("name", LOOPS)
def test_loops(name, in_registers, monkeypatch):
    monkeypatch.setattr(fused_loop, "REGISTERS", 1000 if in_registers else 0)
    controller, plant, sensor = LOOPS[name]
    loop = Feedback(controller, plant, Saturation(-20.0, 120.0), sensor)
    path = "sensor.noise_rms" if name == "observer" else "sensor.0.noise_rms"
    assert_equal(*both(loop, path, 3, loop_inputs(), Tracking(start=4), start=1.0))


class Stored(System):
    """A system whose step reads a long array."""

    values: jax.Array

    def init(self, input=0.0):
        return jnp.zeros((), int)

    def step(self, state, input):
        return state + 1, self.values[state % 300] * input


class Searching(System):
    """A system whose step repeats until it has converged."""

    goal: jax.Array

    def init(self, input=0.0):
        return as_array(input)

    def step(self, state, input):
        state = jax.lax.while_loop(
            lambda x: jnp.abs(x * x - self.goal) > 1e-12,
            lambda x: 0.5 * (x + self.goal / x),
            2.0 + state + input,
        )
        return state, state


class Sorting(System):
    """A system with an operation that no kernel has."""

    gain: jax.Array

    def init(self, input=0.0):
        return jnp.zeros(3)

    def step(self, state, input):
        state = jnp.sort(jnp.stack([input, state[0], self.gain * state[1]]))
        return state, state[1]


@pytest.mark.parametrize(
    "system", [Stored(jnp.arange(300.0)), Searching(2.0), Sorting(0.5)]
)
def test_other_steps_run_in_a_plain_loop(system):
    inputs = driven()

    def simulated(values, fused):
        def run_of(value):
            changed = jax.tree.map(lambda x: value * x, system)
            return changed, changed.init(0.0)

        return simulate_lanes(run_of, values, inputs, Means(), fused=fused)

    values = jnp.array([0.5, 1.0, 2.0])
    assert "pallas_call" not in str(jax.make_jaxpr(simulated, 1)(values, True))
    np.testing.assert_array_equal(
        *(
            jax.jit(simulated, static_argnums=1)(values, fused)
            for fused in (True, False)
        )
    )


def test_the_kernel_of_a_loop_compiles_for_a_gpu():
    loop = p753.loop(p753.disturbance_observer())

    def simulated(values):
        def run_of(value):
            changed = replace(loop, {"controller.cutoff": value})
            return changed, changed.init(0.0)

        inputs = loop_inputs()
        return simulate_lanes(run_of, values, inputs, Tracking(), fused=True)

    lowered = jax.jit(simulated).trace(jnp.linspace(500.0, 2000.0, 200))
    text = lowered.lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("__gpu$xla.gpu.triton") == 1


def test_a_sweep_uses_the_kernel_and_larger_blocks_on_a_gpu(case_of, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    table = {"method": "sobol", "samples": 1000, "metrics": ["rms_error"]}
    simulator = Simulator(case_of(table))
    assert simulator.plan.width == 1000
    values = jnp.zeros((1000, len(simulator.plan.axes)))
    block = jax.make_jaxpr(simulator._block)(
        simulator.case.loop, values, simulator.reference, simulator.run_noise
    )
    assert "pallas_call" in str(block)
    assert Simulator(case_of(table | {"chunk": 100})).plan.width == 100
    assert Simulator(case_of(table | {"chunk": 10})).plan.width == 64


@pytest.mark.parametrize("name", ["max", "min"])
def test_nan_passes_a_limit(name):
    values = jnp.array([-np.inf, -1.0, 0.0, 2.0, np.inf, np.nan])
    a, b = (x.ravel() for x in jnp.meshgrid(values, values))
    found = fused_loop.OPERATIONS[name](a, b)
    numpy = {"max": np.maximum, "min": np.minimum}[name]
    np.testing.assert_array_equal(found, numpy(np.asarray(a), np.asarray(b)))
    clamped = fused_loop.OPERATIONS["clamp"](as_array(-1.0), values, as_array(1.0))
    np.testing.assert_array_equal(clamped, np.clip(np.asarray(values), -1.0, 1.0))


def test_a_loop_that_diverges_is_reported():
    loop = p753.loop(p753.pid())
    found, expected = both(
        loop,
        "controller.proportional",
        3,
        loop_inputs(),
        Tracking(start=4),
        scale=1e308,
    )
    assert not np.isfinite(found[0]).any()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(np.isnan(one), np.isnan(other))


@example(x=np.nextafter(0.5, 0.0))
@given(x=st.floats(-1e9, 1e9) | st.integers(-99, 99).map(lambda n: 0.5 * n))
def test_rounding(x):
    even = jax.lax.RoundingMethod.TO_NEAREST_EVEN
    away = jax.lax.RoundingMethod.AWAY_FROM_ZERO
    assert fused_loop._rounded(as_array(x), even) == np.rint(x)
    rest, whole = np.modf(x)
    expected = whole + np.sign(x) * (abs(rest) >= 0.5)
    assert fused_loop._rounded(as_array(x), away) == expected
