import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import dynamics as oracle
from oracles import hysteresis
from oracles.published import HYSTERESIS, MODEL_533_A, MODEL_533_B, T2_G, T2_P

from piezojax import (
    Feedback,
    loop_inputs,
    series,
    simulate,
)
from piezojax.catalog import p753
from piezojax.control import (
    PID,
    DisturbanceObserverControl,
    InversionControl,
)
from piezojax.core.feedback import holding_input
from piezojax.core.system import Affine, Delay, Parallel, Series, rest_output
from piezojax.dynamics import (
    ARMA,
    FirstOrderLag,
)
from piezojax.hardware import (
    Quantiser,
    Saturation,
    Sensor,
    SlewLimit,
)
from piezojax.hysteresis import (
    ColemanHodgdon,
    InverseColemanHodgdon,
)

DT = 5e-5
GAIN, SHIFT, DOUBLE = Affine(3.0), Affine(1.0, 0.5), Affine(2.0)


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def rough(samples=500):
    return np.random.default_rng(8).uniform(-10.0, 60.0, samples)


def test_affine_scales_and_shifts():
    np.testing.assert_allclose(
        response(Affine(3.0, -2.0), rough(), 0.0), 3.0 * rough() - 2.0, rtol=1e-15
    )
    assert response(Affine(), 4.0 * np.ones(3), 0.0).tolist() == [4.0, 4.0, 4.0]


@pytest.mark.parametrize("samples", [0, 1, 16, 17, 400])
def test_delay_shifts_and_starts_full(samples):
    expected = np.concatenate([np.full(samples, 9.0), rough()])[:500]
    np.testing.assert_array_equal(response(Delay(samples), rough(), 9.0), expected)


def test_series_feeds_each_part_with_the_output_before():
    chain = Series((ColemanHodgdon(*HYSTERESIS), Delay(2), ARMA(T2_P, T2_G)))
    bent = hysteresis.trapezoid(rough(), *HYSTERESIS)
    expected = oracle.arma(np.concatenate([[0.0, 0.0], bent])[:500], T2_P, T2_G)
    np.testing.assert_allclose(
        response(chain, rough(), 0.0), expected, rtol=0.0, atol=1e-10
    )


def test_series_keeps_the_order_of_its_parts():
    # (3 u)(1) + 0.5 is not 3 (u + 0.5).
    assert float(rest_output(GAIN >> SHIFT, 2.0)) == 6.5
    assert float(rest_output(SHIFT >> GAIN, 2.0)) == 7.5


def test_parallel_adds_the_outputs():
    both = ARMA((0.9,), (0.1,)) + Affine(2.0) + Delay(1)
    expected = oracle.arma(rough(), (0.9,), (0.1,)) + 2.0 * rough()
    expected += np.concatenate([[0.0], rough()[:-1]])
    np.testing.assert_allclose(
        response(both, rough(), 0.0), expected, rtol=0.0, atol=1e-10
    )


def test_operators_flatten():
    assert (GAIN >> SHIFT >> DOUBLE).parts == (GAIN, SHIFT, DOUBLE)
    assert (GAIN >> (SHIFT >> DOUBLE)).parts == (GAIN, SHIFT, DOUBLE)
    assert (GAIN + SHIFT + DOUBLE).parts == (GAIN, SHIFT, DOUBLE)
    assert (GAIN + (SHIFT + DOUBLE)).parts == (GAIN, SHIFT, DOUBLE)


def test_operators_bind_as_in_python():
    # `+` before `>>`: the sum is one part of the chain.
    chain = GAIN >> SHIFT + DOUBLE
    assert isinstance(chain, Series)
    assert chain.parts[0] is GAIN
    assert isinstance(chain.parts[1], Parallel)
    assert float(rest_output(chain, 1.0)) == 3.5 + 6.0


def test_a_named_chain_stays_one_part():
    named = series(first=GAIN, second=SHIFT)
    chain = named >> DOUBLE
    assert named.names == ("first", "second")
    assert chain.parts == (named, DOUBLE)
    assert float(rest_output(chain, 2.0)) == 13.0


def test_names_must_match_the_parts():
    with pytest.raises(ValueError, match=r"2 parts but names \('one',\)"):
        Series((GAIN, SHIFT), ("one",))


def test_negative_delay_is_refused():
    with pytest.raises(ValueError, match=r"samples is -1; .* at least 0"):
        Delay(-1)


def test_a_long_delay_compiles_to_few_operations():
    def operations(samples):
        system = Delay(samples)
        step = jax.make_jaxpr(system.step)(system.init(0.0), 1.0)
        return len(jax.tree.leaves(system.init(0.0))), len(step.eqns)

    assert operations(1000) == operations(17)
    assert operations(17)[0] == 1


@pytest.mark.parametrize("samples", [1001, 10**9, 10**30])
def test_a_delay_of_too_many_samples_is_refused(samples):
    with pytest.raises(ValueError, match=r"samples is 1.*; it must .*at most 1000"):
        Delay(samples)


def test_an_integer_too_large_for_a_float_is_refused():
    message = r"an integer is too large; the largest number is 1\.8e308"
    for wrong in (lambda: Affine(10**400), lambda: Delay(10**400)):
        with pytest.raises(ValueError, match=message):
            wrong()


def test_fractional_delay_is_refused():
    # In the tests the check of the annotations raises first.
    message = r"samples is 1\.5; it must be whole|parameter 'samples'"
    with pytest.raises((ValueError, TypeError), match=message):
        Delay(1.5)


ELEMENTS = {
    **{
        f"hysteresis {s}": ColemanHodgdon(*HYSTERESIS, scheme=s)
        for s in ("trapezoid", "quadratic", "voros", "exact")
    },
    "other rest": ColemanHodgdon(*HYSTERESIS, rest_input=10.0, rest_output=1.0),
    "inverse": InverseColemanHodgdon(ColemanHodgdon(*HYSTERESIS)),
    "arma": ARMA(MODEL_533_A, MODEL_533_B),
    "fir": ARMA((), (0.5, 0.25)),
    "lag": FirstOrderLag(1e-3, DT),
    "affine": Affine(2.0, -1.0),
    "delay": Delay(3),
    "saturation": Saturation(-20.0, 120.0),
    "slew": SlewLimit(1e3, DT),
    "quantiser": Quantiser(0.01),
    "plant": p753.plant(),
    "exact plant": p753.plant("exact"),
    "quadratic plant": p753.plant("quadratic"),
    "long plant": series(
        amplifier=FirstOrderLag(1e-4, DT),
        limits=Saturation(-20.0, 120.0),
        delay=Delay(2),
        stage=p753.plant(),
        calibration=Affine(1.01, 0.02),
    ),
    "sum": p753.plant() + (FirstOrderLag(1e-2, DT) >> Affine(0.01)),
}


@jax.jit
def drift(system, level):
    """Return the largest change of state and output over two steps at rest."""
    state = system.init(level)
    first, output = system.step(state, level)
    second, again = system.step(first, level)
    moved = jax.tree.map(
        lambda *leaf: jnp.abs(leaf[0] - leaf[1]),
        (state, first, output),
        (first, second, again),
    )
    return jnp.max(jnp.stack(jax.tree.leaves(moved)))


@pytest.mark.parametrize("system", ELEMENTS.values(), ids=ELEMENTS)
@settings(max_examples=20, deadline=None)
@given(level=st.floats(-15.0, 15.0))
def test_a_step_at_rest_changes_nothing(system, level):
    assert drift(system, level) < 1e-9


def test_a_sensor_at_rest_changes_nothing():
    sensor = Sensor(0.012)
    state = sensor.init((4.0, 0.0))
    assert sensor.step(state, (4.0, 0.0)) == (state, 4.0)


holding = jax.jit(holding_input)


@pytest.mark.parametrize(
    "name", ["hysteresis exact", "other rest", "affine", "arma", "plant", "sum"]
)
@settings(max_examples=20, deadline=None)
@given(output=st.floats(-2.0, 15.0))
def test_holding_input_keeps_the_plant_at_rest(name, output):
    plant = ELEMENTS[name]
    assert abs(rest_output(plant, holding(plant, output)) - output) < 1e-10


def test_holding_input_of_the_published_plant():
    # On the loading curve; the dynamics pass it unchanged.
    expected = hysteresis.exact_step(0.0, 0.0, 55.0, *HYSTERESIS)
    np.testing.assert_allclose(holding(p753.plant(), expected), 55.0, rtol=1e-11)


def test_holding_input_has_the_gradient_of_the_inverse_function():
    a, b, c = HYSTERESIS
    found = jax.grad(lambda y: holding(p753.plant(), y))(6.0)
    voltage = float(holding(p753.plant(), 6.0))
    np.testing.assert_allclose(found, 1.0 / (a * voltage + b + c * 6.0), rtol=1e-9)


LIMITED = series(limits=Saturation(-20.0, 120.0), stage=p753.plant())


def test_holding_input_beyond_reach_is_finite():
    assert np.isfinite(holding(LIMITED, 40.0))


LOOPS = {
    "pid": p753.loop(p753.pid()),
    "sliding mode": p753.loop(p753.sliding_mode()),
    "inversion": p753.loop(p753.inversion()),
    "observer": p753.loop(p753.disturbance_observer()),
    "printed observer": p753.loop(p753.disturbance_observer(coefficients="printed")),
    "pid behind the inverse": p753.loop(
        InversionControl(
            PID(0.05, 1e3, 1e-6, DT, 100.0, dt=DT), p753.inversion().inverse
        )
    ),
    "pid with observer": p753.loop(
        DisturbanceObserverControl(
            PID(0.05, 100.0, anti_windup=100.0, dt=DT),
            ARMA(T2_P, T2_G),
            p753.GAIN,
            500.0,
            DT,
        )
    ),
    # A plant that the controller's model does not match.
    "mismatched": Feedback(
        p753.inversion(),
        series(delay=Delay(1), stage=p753.plant("exact"), zero=Affine(0.9, 0.3)),
        series(limits=p753.actuator(), slew=SlewLimit(1e5, DT)),
        Sensor(0.012),
    ),
}


@jax.jit
def start_at(loop, reference):
    inputs = loop_inputs(jnp.full(200, 1.0) * reference)
    return simulate(loop, inputs, loop.init(reference))[1]


start_at_each = jax.jit(jax.vmap(start_at, in_axes=(None, 0)))


@pytest.mark.parametrize("loop", LOOPS.values(), ids=LOOPS)
def test_a_loop_started_at_a_reference_stays_at_rest(loop):
    references = np.array([-1.5, 0.0, 0.3, 5.0, 12.0])
    samples = start_at_each(loop, references)
    for moved in (samples.displacement, samples.measured):
        np.testing.assert_allclose(
            moved - references[:, None], np.zeros((5, 200)), rtol=0.0, atol=1e-9
        )
    held = np.broadcast_to(samples.voltage[:, :1], (5, 200))
    np.testing.assert_allclose(samples.voltage, held, rtol=0.0, atol=1e-7)
    assert np.all((samples.voltage > -20.0) & (samples.voltage < 120.0))


@pytest.mark.parametrize("loop", LOOPS.values(), ids=LOOPS)
@pytest.mark.parametrize("reference", [-40.0, 60.0])
def test_a_loop_started_beyond_reach_keeps_its_limits(loop, reference):
    samples = start_at_each(loop, np.full(5, reference))
    assert np.all(np.isfinite(np.concatenate(samples)))
    assert np.all((samples.voltage >= -20.0) & (samples.voltage <= 120.0))


def test_the_measurement_comes_before_the_voltage_acts():
    loop = p753.loop(p753.pid())
    reference = jnp.array([0.0, 0.0, 5.0, 5.0, 5.0])
    samples = simulate(loop, loop_inputs(reference), loop.init(0.0))[1]
    np.testing.assert_array_equal(samples.reference, reference)
    np.testing.assert_array_equal(samples.voltage != 0.0, [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(samples.displacement != 0.0, [0, 0, 0, 1, 1])


def test_a_disturbance_moves_the_next_displacement():
    loop = p753.loop(p753.pid())
    pulse = jnp.array([0.0, 0.5, 0.0, 0.0])
    inputs = loop_inputs(jnp.zeros(4), disturbance=pulse)
    samples = simulate(loop, inputs, loop.init(0.0))[1]
    np.testing.assert_array_equal(samples.displacement[:3], [0.0, 0.0, 0.5])
    # The stage does not move: only the response of the controller moves it.
    assert samples.voltage[1] == 0.0 > samples.voltage[2]
    assert samples.displacement[3] < 0.0


def test_loop_inputs_look_one_sample_ahead():
    reference, draws = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.2, 0.3])
    inputs = loop_inputs(reference)
    assert inputs.next_reference.tolist() == [2.0, 3.0, 3.0]
    assert inputs.noise.tolist() == [0.0, 0.0, 0.0]
    assert inputs.disturbance is None
    assert loop_inputs(reference, draws).noise is draws
