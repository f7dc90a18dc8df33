"""Many lanes in one kernel, against the loop of ``simulate``."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilers import assert_simd, needs_gcc
from hypothesis import example, given
from hypothesis import strategies as st
from jax.errors import JaxRuntimeError

import piezojax as pj
from piezojax.catalog import p753
from piezojax.control import FeedforwardFeedback
from piezojax.core.arrays import as_array
from piezojax.core.feedback import Feedback, LoopInput
from piezojax.core.metrics import Chosen, Tracking
from piezojax.core.paths import replace
from piezojax.core.rollout import Metric
from piezojax.core.system import Affine, Delay, System
from piezojax.dynamics import FirstOrderLag
from piezojax.engines import (
    default_engine,
    forward,
    gpu_kernel,
    lane_values,
    metered,
    reverse_mode,
)
from piezojax.engines import native_library as library
from piezojax.hardware import Quantiser, Saturation, Sensor
from piezojax.hysteresis import InverseHysteresis, PrandtlIshlinskii

SAMPLES = 12

DROPPING = ("max", "min", "clamp")
"""Operations that drop NaN in a kernel of a GPU, but not when it is interpreted."""

needs_compiler = pytest.mark.skipif(
    library.compiler() is None, reason="there is no C compiler"
)
ENGINES = [pytest.param("native", marks=needs_compiler), "interpreted"]


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


class Plain(System):
    """Operations that every engine has, on the input and a state of each type."""

    gain: jax.Array

    def init(self, input=0.0):
        return as_array(0.3), jnp.zeros((), int), jnp.zeros((), bool)

    def step(self, state, input):
        x, count, above = state
        x, count = 0.5 * x + self.gain * input, count + 3
        return (x, count, x > 0.0), sum(
            i * as_array(value) for i, value in enumerate(self.values(x, count, above))
        )

    def values(self, x, count, above):
        return [
            *(jnp.abs(x), jnp.ceil(x), 1.0 / (x + 9), jnp.floor(x), x / self.gain),
            *(jnp.maximum(x, 0.2), jnp.minimum(x, 0.1), -x, x**3, x**-2, x / 7.0),
            *(jnp.clip(x, -0.9, 0.9), jax.lax.rsqrt(x + 9), jnp.sign(x), jnp.square(x)),
            *(jnp.sqrt(x + 9), jnp.round(4.0 * x), (x > 0.1) ^ above, ~above, -count),
            *((x > 0.1) | above, (x <= 0.3) & (x >= -0.3), x == 0.0, x != 0.0, count),
            *(jnp.where(x < 0.1, x, 7.0), jnp.isfinite(x), jnp.abs(count - 20)),
            *(jnp.exp(x), jnp.expm1(x), jnp.log(x + 9), jnp.log1p(x + 9), jnp.tanh(x)),
            *(jax.nn.sigmoid(x), (x + 9) ** 1.7, (x + 9) ** self.gain),
        ]


class Everything(Plain):
    """Every operation of a kernel of a GPU."""

    def values(self, x, count, above):
        unit = jnp.clip(x, -0.9, 0.9)
        return [
            *super().values(x, count, above),
            *(jnp.arccos(unit), jnp.arcsin(unit), jnp.arctan(x), jnp.arctan2(x, 0.3)),
            *(jnp.cos(x), jnp.cosh(x), jnp.sin(x), jnp.sinh(x), jnp.tan(x)),
            *(jax.lax.rem(x, 0.7), count % 5),
            jax.lax.round(4.0 * x, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
        ]


def primitives(jaxpr):
    """Yield the names of the operations of a jaxpr and of the jaxprs inside it."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in equation.params.values():
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from primitives(inner)


def equations(jaxpr, name):
    """Return the equations of an operation in a jaxpr."""
    return [each for each in jaxpr.eqns if each.primitive.name == name]


def kernel_of(program, *arguments):
    """Return the jaxpr of the kernel of a GPU in a program."""
    (run,) = equations(jax.make_jaxpr(program)(*arguments).jaxpr, "metered_run")
    operands = [variable.aval for variable in run.invars]
    inside = jax.make_jaxpr(partial(forward._evaluated, **run.params))(*operands)
    (call,) = equations(inside.jaxpr, "pallas_call")
    return call.params["jaxpr"]


def lowered(program, *arguments, platform="cpu"):
    """Return the text of a program lowered for a platform."""
    traced = jax.jit(program).trace(*arguments)
    return traced.lower(lowering_platforms=(platform,)).as_text()


def is_native(program, *arguments):
    return "custom_call @piezojax_" in lowered(program, *arguments)


def driven(amplitude=60.0):
    rng = np.random.default_rng(3)
    return jnp.array(amplitude * rng.uniform(0.0, 1.0, SAMPLES))


def loop_inputs():
    rng = np.random.default_rng(5)
    steps = jnp.array(np.repeat(rng.uniform(0.0, 5.0, SAMPLES // 3), 3))
    return LoopInput(steps, jnp.array(rng.standard_normal(SAMPLES)))


def lanes_of(system, path, inputs, metric, start=0.0):
    """Return a function from values of ``path`` and an engine to the results."""

    def simulated(values, engine, **options):
        def lane(value):
            changed = replace(system, {path: value})
            state = changed.init(start)
            return metered(changed, inputs, state, metric, engine=engine, **options)

        return jax.vmap(lane)(values)

    return simulated


def spread(lanes, scale=1.0):
    return scale * jnp.linspace(0.5, 1.5, lanes)


def assert_equal(found, expected):
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    for one, other in pairs:
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)


def assert_engine_equals_loop(engine, simulated, values):
    """Fail unless an engine has the results of the loop; return them."""
    if engine == "native":
        assert is_native(lambda v: simulated(v, engine), values)
    found = jax.jit(lambda v: simulated(v, engine))(values)
    assert_equal(found, jax.jit(lambda v: simulated(v, "loop"))(values))
    return found


@pytest.mark.parametrize("engine", ENGINES)
def test_every_operation(engine):
    system = (Plain if engine == "native" else Everything)(as_array(1.0))
    simulated = lanes_of(system, "gain", driven(2.0) - 1.0, Means())
    means, _ = assert_engine_equals_loop(engine, simulated, spread(5))
    assert np.ptp(np.asarray(means)[:, 0]) > 1.0  # the lanes differ


@pytest.mark.parametrize("lanes", [1, 2, 8, 9, 16, 64, 65, 130])
@pytest.mark.parametrize("engine", ENGINES)
def test_any_number_of_lanes(engine, lanes):
    def simulated(values, engine):
        def lane(value):
            system = FirstOrderLag(1e-3, 1e-4) >> Affine(value, 0.3)
            start = system.init(10.0 * value)
            return metered(system, driven(), start, Means(), engine=engine)[0]

        return jax.vmap(lane)(values)

    means = assert_engine_equals_loop(engine, simulated, spread(lanes))
    assert means.shape == (lanes, 2)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_single_run(engine):
    system = Plain(as_array(1.0))

    def simulated(inputs, engine):
        return metered(system, inputs, system.init(), Means(), engine=engine)[0]

    found = jax.jit(simulated, static_argnums=1)(driven(), engine)
    _, expected = pj.simulate(system, driven(), metric=Means())
    assert_equal(found, expected)
    assert_equal(simulated(driven(), engine), expected)  # without jit


@pytest.mark.parametrize("engine", ENGINES)
def test_a_system_without_state_or_numbers(engine):
    def simulated(values, engine):
        def lane(value):
            return metered(
                Delay(2), driven(), Delay(2).init(value), Means(), engine=engine
            )

        return jax.vmap(lane)(values)

    assert_engine_equals_loop(engine, simulated, jnp.array([0.5, 1.0]))


class Second(System):
    """A system that passes the second of two inputs."""

    gain: jax.Array

    def init(self, input=0.0):
        return ()

    def step(self, state, input):
        return state, self.gain * input[1]


@pytest.mark.parametrize("engine", ENGINES)
def test_an_empty_leaf_before_the_inputs(engine):
    inputs = jnp.zeros((SAMPLES, 0)), driven()
    simulated = lanes_of(Second(as_array(1.0)), "gain", inputs, Means())
    assert_engine_equals_loop(engine, simulated, spread(3))


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
    # Its Newton steps are a loop of fixed length, which the kernels unroll.
    "numerical inverse": (
        FeedforwardFeedback(
            InverseHysteresis(p753.hysteresis(), -20.0, 120.0), p753.pid()
        ),
        p753.plant(),
        Sensor(0.01),
    ),
}


def loop_lanes(name):
    controller, plant, sensor = LOOPS[name]
    loop = Feedback(controller, plant, Saturation(-20.0, 120.0), sensor)
    path = "sensor.0.noise_rms" if "converter" in name else "sensor.noise_rms"
    return lanes_of(loop, path, loop_inputs(), Tracking(start=4), start=1.0)


@needs_compiler
@pytest.mark.parametrize("lanes", [1, 8, 17])
@pytest.mark.parametrize("name", LOOPS)
def test_loops_in_c(name, lanes):
    assert_engine_equals_loop("native", loop_lanes(name), spread(lanes))


@needs_gcc
@pytest.mark.parametrize("name", LOOPS)
def test_the_lanes_of_a_loop_are_simd(name, sources):
    lowered(lambda v: loop_lanes(name)(v, "native"), spread(8))
    assert_simd(sources[0])


@pytest.mark.parametrize("in_registers", [True, False])
@pytest.mark.parametrize("name", LOOPS)
def test_loops_on_a_gpu(name, in_registers, monkeypatch):
    monkeypatch.setattr(gpu_kernel, "REGISTERS", 1000 if in_registers else 0)
    simulated = loop_lanes(name)
    found = {*primitives(kernel_of(lambda v: simulated(v, "gpu"), spread(3)))}
    assert found.isdisjoint(DROPPING)
    assert_engine_equals_loop("interpreted", simulated, spread(3))


@needs_compiler
@pytest.mark.parametrize(
    ("every", "paths", "draws"), [(0, 2, 3), (1, 2, 3), (5, 2, 3), (5, 1, 3)]
)
def test_each_lane_and_draw_has_its_inputs(every, paths, draws):
    """Axes of plants, references and draws, in any order, with time first or last."""
    rng = np.random.default_rng(7)
    references = jnp.array(rng.uniform(0.0, 5.0, (SAMPLES, paths)))
    noise = jnp.array(rng.standard_normal((draws, SAMPLES, paths)))
    loop = p753.loop(p753.disturbance_observer())

    def error(sample):
        return sample.displacement - sample.reference

    def simulated(cutoffs, engine):
        def one(cutoff, reference, noise):
            changed = replace(loop, {"controller.cutoff": cutoff})
            return metered(
                changed,
                LoopInput(reference, noise),
                changed.init(reference[0]),
                Chosen(Tracking(start=2), ("rms_error", "peak_voltage")),
                log=error if every else None,
                every=every or 1,
                engine=engine,
            )

        each_draw = jax.vmap(one, (None, None, 0))
        runs = jax.vmap(each_draw, (None, 1, 2))
        return jax.vmap(runs, (0, None, None))(cutoffs, references, noise)

    values = spread(4, 900.0)
    figures, log = assert_engine_equals_loop("native", simulated, values)
    assert {*figures} == {"rms_error", "peak_voltage"}
    assert figures["rms_error"].shape == (4, paths, draws)
    assert len({*np.asarray(figures["rms_error"]).ravel()}) == 4 * paths * draws
    assert (log is None) == (every == 0)
    if every:
        assert log.shape == (4, paths, draws, SAMPLES // every)

    def slopes(values, engine):
        """Return derivatives for all cut-offs and for each alone."""

        def along(direction):
            return jax.jvp(lambda v: simulated(v, engine), (values,), (direction,))[1]

        return along(jnp.ones(4)), jax.vmap(along, out_axes=-1)(jnp.eye(4))

    total, _ = assert_engine_equals_loop("native", slopes, values)
    step = 1e-2
    below, above = (simulated(values + d, "loop")[0] for d in (-step, step))
    for name, slope in total[0].items():
        differences = (above[name] - below[name]) / (2.0 * step)
        np.testing.assert_allclose(slope, differences, rtol=1e-5, atol=1e-12)


@needs_compiler
@pytest.mark.parametrize(
    ("places", "kernels"), [((0,), 2), ((1,), 2), ((0, 1), 2), ((2,), 1), ((0, 2), 1)]
)
def test_derivatives_by_gain_start_and_inputs(places, kernels):
    """Derivatives with respect to inputs have no kernel; the others have one."""
    system = Plain(as_array(1.0)) >> FirstOrderLag(1e-3, 1e-4)

    def total(gain, x, inputs, engine):
        changed = replace(system, {"0.gain": gain})
        (_, count, above), lag = changed.init()
        state = (x, count, above), lag
        return jnp.sum(metered(changed, inputs, state, Means(), engine=engine)[0])

    parts = as_array(1.1), as_array(0.2), driven(2.0)
    for mode in (jax.jacfwd, jax.jacrev):
        program = jax.jit(mode(total, places), static_argnums=3)
        assert_equal(program(*parts, "native"), program(*parts, "loop"))
    forward = lowered(lambda *p: jax.jacfwd(total, places)(*p, "native"), *parts)
    assert forward.count("custom_call @piezojax_") == kernels


@needs_compiler
@pytest.mark.parametrize("own_inputs", [True, False])
@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize(("lanes", "spread_out"), [(1, True), (2, True), (8, False)])
def test_directions_become_lanes_where_lanes_are_few(
    lanes, spread_out, every, own_inputs, monkeypatch
):
    """Except for a log of few samples: inputs of each lane are not copied for it."""
    inputs = driven() + jnp.arange(float(lanes))[:, None]

    def outputs(weights, input, engine):
        plays = PrandtlIshlinskii(
            polynomial=[0.0, 0.1], thresholds=jnp.arange(1.0, 13.0), weights=weights
        )
        system = plays >> FirstOrderLag(3e-4, p753.DT)
        run = system, input, system.init(2.0)
        return metered(*run, log=lambda y: y, every=every, engine=engine)[1]

    def jacobians(weights, engine):
        slopes = jax.jacfwd(partial(outputs, engine=engine))
        if own_inputs:
            return jax.vmap(slopes)(weights, inputs)
        return jax.vmap(slopes, (0, None))(weights, inputs[0])

    seen, spread_of = [], forward.Batch.spread
    monkeypatch.setattr(
        forward.Batch, "spread", lambda batch: seen.append(batch) or spread_of(batch)
    )
    weights = jnp.linspace(0.001, 0.01, lanes * 12).reshape(lanes, 12)
    assert_engine_equals_loop("native", jacobians, weights)
    copied = own_inputs and lanes > 1
    assert bool(seen) == (spread_out and (every == 1 or not copied))


@pytest.mark.parametrize("engine", ENGINES)
def test_a_log_without_a_metric(engine):
    system = Plain(as_array(1.0))

    def logged(engine, every):
        return metered(
            *(system, driven(2.0), system.init()),
            log=lambda output: {"output": output, "double": 2.0 * output},
            every=every,
            engine=engine,
        )

    _, outputs = pj.simulate(system, driven(2.0))
    for every in (1, 5):
        none, log = logged(engine, every)
        assert none is None
        wanted = outputs[every - 1 :: every][: SAMPLES // every]
        np.testing.assert_allclose(log["output"], wanted, rtol=1e-12)
        np.testing.assert_allclose(log["double"], 2.0 * wanted, rtol=1e-12)


@needs_compiler
def test_second_derivatives():
    system = FirstOrderLag(1e-3, 1e-4) >> Affine(1.0, 0.3)

    def total(gain, engine):
        changed = replace(system, {"1.gain": gain})
        means, _ = metered(changed, driven(), changed.init(), Means(), engine=engine)
        return jnp.sum(means)

    for outer in (jax.jacfwd, jax.jacrev):
        curvature = jax.jit(outer(jax.jacfwd(total)), static_argnums=1)
        assert_equal(curvature(1.2, "native"), curvature(1.2, "loop"))


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


@pytest.mark.parametrize("engine", ["native", "gpu"])
@pytest.mark.parametrize(
    "system", [Stored(jnp.arange(300.0)), Searching(2.0), Sorting(0.5)]
)
def test_other_steps_run_in_the_loop(system, engine):
    def simulated(values, engine):
        def lane(value):
            changed = jax.tree.map(lambda x: value * x, system)
            state = changed.init(0.0)
            return metered(changed, driven(), state, Means(), engine=engine)[0]

        return jax.vmap(lane)(values)

    values = jnp.array([0.5, 1.0, 2.0])
    assert "custom_call" not in lowered(lambda v: simulated(v, engine), values)
    program = jax.jit(simulated, static_argnums=1)
    np.testing.assert_array_equal(program(values, engine), program(values, "loop"))


def test_a_long_step_runs_in_no_kernel_of_a_gpu(monkeypatch):
    simulated = lanes_of(FirstOrderLag(1e-3, 1e-4), "time_constant", driven(), Means())
    values = spread(3, 1e-3)
    kernel_of(lambda v: simulated(v, "gpu"), values)
    monkeypatch.setattr(gpu_kernel, "MOST", 3)
    with pytest.raises(ValueError, match="not enough values to unpack"):
        kernel_of(lambda v: simulated(v, "gpu"), values)
    assert_engine_equals_loop("interpreted", simulated, values)


@pytest.mark.skipif(
    jax.__version_info__ >= (0, 12),
    reason="this version of JAX lowers for a GPU only where there is one",
)
def test_the_kernel_of_a_loop_compiles_for_a_gpu():
    loop = p753.loop(p753.disturbance_observer())
    simulated = lanes_of(loop, "controller.cutoff", loop_inputs(), Tracking())
    values = spread(200, 1000.0)
    text = lowered(lambda v: simulated(v, "gpu"), values, platform="cuda")
    assert text.count("__gpu$xla.gpu.triton") == 1


@pytest.mark.parametrize("name", ["max", "min"])
def test_nan_passes_a_limit(name):
    values = jnp.array([-np.inf, -1.0, 0.0, 2.0, np.inf, np.nan])
    a, b = (x.ravel() for x in jnp.meshgrid(values, values))
    found = lane_values.OPERATIONS[name](a, b)
    numpy = {"max": np.maximum, "min": np.minimum}[name]
    np.testing.assert_array_equal(found, numpy(np.asarray(a), np.asarray(b)))
    clamped = lane_values.OPERATIONS["clamp"](as_array(-1.0), values, as_array(1.0))
    np.testing.assert_array_equal(clamped, np.clip(np.asarray(values), -1.0, 1.0))


class Limits(System):
    """Limits and signs of the input and a number."""

    number: jax.Array

    def init(self, input=0.0):
        return ()

    def step(self, state, input):
        a, b = self.number, input
        first = jnp.stack([jnp.maximum(a, b), jnp.minimum(a, b), jnp.maximum(b, a)])
        more = jnp.stack([jnp.sign(b), jnp.clip(b, -1.0, 1.0), jnp.isfinite(b) + 0.0])
        return state, jnp.concatenate([first, more])


class Last(Metric):
    """The last output."""

    def init(self):
        return jnp.zeros(6)

    def update(self, total, index, output):
        return output

    def result(self, total):
        return total


@needs_compiler
def test_c_keeps_nan_and_infinity():
    values = jnp.array([-np.inf, -1.0, -0.0, 0.0, 2.0, np.inf, np.nan])
    a, b = (x.ravel() for x in jnp.meshgrid(values, values))

    @jax.jit
    def last(a, b):
        return metered(Limits(a), b[None], (), Last(), engine="native")[0]

    found = np.asarray(jax.vmap(last)(a, b)).T
    a, b = np.asarray(a), np.asarray(b)
    expected = [np.maximum(a, b), np.minimum(a, b), np.maximum(b, a), np.sign(b)]
    np.testing.assert_array_equal(
        found, [*expected, np.clip(b, -1.0, 1.0), np.isfinite(b)]
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_a_loop_that_diverges_is_reported(engine):
    loop = p753.loop(p753.pid())
    simulated = lanes_of(
        loop, "controller.proportional", loop_inputs(), Tracking(start=4)
    )
    found, expected = (simulated(spread(3, 1e308), e)[0] for e in (engine, "loop"))
    assert not np.isfinite(found.rms_error).any()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(np.isnan(one), np.isnan(other))


@example(x=np.nextafter(0.5, 0.0))
@given(x=st.floats(-1e9, 1e9) | st.integers(-99, 99).map(lambda n: 0.5 * n))
def test_rounding(x):
    even = jax.lax.RoundingMethod.TO_NEAREST_EVEN
    away = jax.lax.RoundingMethod.AWAY_FROM_ZERO
    rounded = lane_values.OPERATIONS["round"]
    assert rounded(as_array(x), even) == np.rint(x)
    rest, whole = np.modf(x)
    expected = whole + np.sign(x) * (abs(rest) >= 0.5)
    assert rounded(as_array(x), away) == expected


def simple(value, scale=1.0):
    system = Affine(as_array(value), scale)
    return metered(system, driven(), (), Means(), engine="native")[0]


@needs_compiler
def test_new_gains_and_lanes_need_no_new_library(compiled):
    program = jax.jit(jax.vmap(lambda v: simple(v, 0.123)))
    first = program(spread(20))
    assert len(compiled) == 1
    assert not np.array_equal(first, program(spread(20, 2.0)))
    jax.jit(jax.vmap(lambda v: simple(v, 0.123)))(spread(40))
    assert len(compiled) == 1


@needs_compiler
@pytest.mark.usefixtures("failing_compiler")
def test_a_failing_compiler_leaves_the_loop():
    program = jax.jit(lambda v: simple(v, 0.456))
    with pytest.warns(UserWarning, match=r"/bin/false fails.*XLA runs the loops"):
        found = program(2.0)
    inputs = np.asarray(driven())[2:]
    outputs = 2.0 * inputs + 0.456
    np.testing.assert_allclose(found, [outputs.mean(), (outputs**2).mean()])


@needs_compiler
@pytest.mark.parametrize(
    ("reversed_", "message"),
    [(False, "no memory for the derivatives"), (True, "no memory for the values of")],
)
def test_a_run_without_memory_fails(reversed_, message, monkeypatch):
    called = library._called

    def starved(text, rows):
        most = "aligned_alloc(64, INT64_MAX + 0 * "
        return called(text.replace("aligned_alloc(64, ", most), rows)

    monkeypatch.setattr(library, "_called", starved)

    def total(value):
        lag = Plain(value) >> FirstOrderLag(1e-3, 1e-4)
        return jnp.sum(metered(lag, driven(), lag.init(), Means(), engine="native")[0])

    with reverse_mode(reversed_), pytest.raises(JaxRuntimeError, match=message):
        jax.jit((jax.grad if reversed_ else jax.jacfwd)(total))(1.7).block_until_ready()


@needs_compiler
def test_a_library_is_kept_and_a_damaged_one_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setattr(library, "_path", lambda name: tmp_path / name)
    text = "#include <stdint.h>\nconst char *run_blocks(int64_t a, ...) { return 0; }\n"
    library._compiled("some", library._called(text, 1))
    kept = tmp_path / "some"
    assert library._kept("some") is not None
    content = kept.read_bytes()
    for damaged in (content[:100], content[:-1], b"x" + content[1:], b""):
        kept.write_bytes(damaged)
        assert library._kept("some") is None
    kept.unlink()
    assert library._kept("some") is None


def test_an_engine_is_chosen_by_the_environment(monkeypatch):
    monkeypatch.setenv("PIEZOJAX_ENGINE", "loop")
    assert default_engine() == "loop"
    assert not is_native(
        lambda u: metered(Affine(2.0, 1.0), u, (), Means())[0], driven()
    )
    monkeypatch.setenv("PIEZOJAX_ENGINE", "fast")
    with pytest.raises(ValueError, match="PIEZOJAX_ENGINE is 'fast'; it must be one"):
        default_engine()
    monkeypatch.delenv("PIEZOJAX_ENGINE")
    monkeypatch.setattr("piezojax.engines.engine.compiler", lambda: None)
    assert default_engine() == "loop"


def test_ragged_inputs_are_refused():
    with pytest.raises(ValueError, match="inputs must share one length in time"):
        metered(
            p753.loop(p753.pid()),
            LoopInput(jnp.zeros(3), jnp.zeros(4)),
            None,
            Tracking(),
        )


@pytest.mark.parametrize("engine", ["native", "loop"])
@pytest.mark.parametrize(
    ("every", "message"),
    [(0, "every is 0; it must be at least 1"), (13, "every is 13; the run has 12")],
)
def test_a_log_that_does_not_fit_is_refused(engine, every, message):
    with pytest.raises(ValueError, match=message):
        metered(Affine(2.0, 1.0), driven(), (), log=abs, every=every, engine=engine)
