import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import control, signals
from oracles.loop import closed_loop
from oracles.published import plant_t2, smc_gains

from piezojax import (
    Feedback,
    series,
    simulate,
)
from piezojax.catalog import p753
from piezojax.control import (
    PID,
    AlphaBeta,
    DisturbanceObserverControl,
    SlidingMode,
    SwitchingPID,
)
from piezojax.core.feedback import LoopInput, Observation
from piezojax.core.system import Delay
from piezojax.dynamics import (
    ARMA,
)
from piezojax.hardware import (
    Sensor,
)

SAMPLES = 20_000  # 1 s
NOISE_RMS = 0.012
DRAWS = np.random.default_rng(11).normal(size=SAMPLES)

PID_GAINS = {
    "P": 0.5,
    "I": 3000.0,
    "D": 1e-5,
    "derivative_filter": 1e-4,
    "anti_windup": 100.0,
}


def pid():
    return PID(*PID_GAINS.values(), dt=p753.DT)


def weighted_pid(proportional, derivative):
    return PID(
        *PID_GAINS.values(),
        proportional_weight=proportional,
        derivative_weight=derivative,
        dt=p753.DT,
    )


# name: controller of the package; kind and gains of the oracle
CONTROLLERS = {
    "pid": (pid(), "pid", PID_GAINS),
    "weighted pid": (weighted_pid(3.0, -2.5), "pid", PID_GAINS | {"b": 3.0, "c": -2.5}),
    "sliding mode": (p753.sliding_mode("5-4"), "smc", smc_gains("smc", "5-5")),
    "inversion": (p753.inversion(), "inversion", smc_gains("inversion", "5-3")),
    "observer": (p753.disturbance_observer(), "dob", smc_gains("dob", "5-3")),
    "printed observer": (
        p753.disturbance_observer(coefficients="printed"),
        "dob",
        {**smc_gains("dob", "5-3"), "q_corrected": False},
    ),
}
PLANTS = {
    "exact": (p753.plant("exact"), plant_t2("exact")),
    "trapezoid": (p753.plant(), plant_t2("trapezoid")),
    "delayed": (
        series(
            hysteresis=p753.hysteresis("exact"),
            delay=Delay(1),
            dynamics=p753.plant().parts[1],
        ),
        plant_t2("exact", delay=1),
    ),
}


def published_references():
    found = signals.ten_references()
    return np.stack([found["SIN10"], found["SW50"], found["PWSW30"]])


def gentle_references():
    # All are within the stroke and start at rest: SW starts at 12 um with a fade-in.
    references = published_references()
    references[1] *= np.minimum(np.arange(SAMPLES + 1) / 2000, 1.0)
    return references


def hard_references():
    # SW jumps to its start; 20 um are beyond the stroke, so the voltage saturates.
    references = published_references()
    references[1, :2] = 0.0
    return np.stack([*references, signals.sine(7, 10.0, 1.0 + 1.0 / p753.RATE)])


REFERENCES = {
    "pid": hard_references,
    "weighted pid": hard_references,
    "sliding mode": hard_references,
    # After clipping, the oracle continues from the requested output and the package
    # from the applied voltage: see the test below.
    "inversion": gentle_references,
    # Beyond the stroke the observer winds up, and rounding errors grow on the return.
    "observer": lambda: hard_references()[:3],
    "printed observer": lambda: hard_references()[:3],
}


@jax.jit
def run(loop, references):
    def one(reference):
        inputs = LoopInput(reference[1:], DRAWS)
        return simulate(loop, inputs, loop.init(0.0))

    return jax.vmap(one)(references)


def around(controller, plant):
    return Feedback(controller, plant, p753.actuator(), Sensor(NOISE_RMS))


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_loop_equals_the_published_one(name, plant):
    controller, kind, gains = CONTROLLERS[name]
    references = REFERENCES[name]()
    if plant is PLANTS["delayed"]:
        references = references[1:]
    samples = run(around(controller, plant[0]), references)[1]
    clipped = False
    for lane, reference in enumerate(references):
        expected = closed_loop(
            kind, reference, plant[1], gains, noise=NOISE_RMS * DRAWS
        )
        clipped |= np.any(expected["command"] != expected["voltage"])
        assert np.abs(expected["displacement"]).max() < 25.0  # stable
        for column, values in expected.items():
            found = getattr(samples, column)[lane]
            np.testing.assert_allclose(
                found, values, rtol=0.0, atol=1e-9, err_msg=column
            )
        np.testing.assert_array_equal(samples.reference[lane], reference[:-1])
    assert clipped == (name != "inversion")


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_start_away_from_zero_holds_the_stage(name):
    loop = Feedback(
        CONTROLLERS[name][0], p753.plant("exact"), p753.actuator(), Sensor(0.0)
    )
    holding = loop.init(5.0)
    still = jnp.asarray(5.0), jnp.asarray(0.0)
    moved, first = loop.step(holding, LoopInput(*still))
    second = loop.step(moved, LoopInput(*still))[1]
    assert holding.voltage > 20.0
    for sample in (first, second):
        assert sample.command == pytest.approx(float(holding.voltage), rel=1e-9)


def test_the_model_of_the_inverse_equals_the_stage_after_clipping():
    loop = around(p753.inversion(), p753.plant())
    state, samples = run(loop, hard_references()[-1:])
    clipped = samples.command != samples.voltage
    assert 0.1 < np.mean(clipped) < 0.9
    state = jax.tree.map(lambda x: x[0], state)
    # The controller has not received the last voltage yet.
    model = loop.controller.inverse.model
    ahead = model.step(state.controller.hysteresis, state.voltage)[0]
    stage = state.plant[0]
    np.testing.assert_allclose(ahead[:2], stage[:2], rtol=0.0, atol=1e-12)
    # Within the stroke it follows again.
    error = samples.displacement - samples.reference
    assert np.abs(error[0, -200:]).max() < 0.5


def test_anti_windup_returns_the_stage_sooner():
    reference = hard_references()[-1:]
    late = []
    for rate in (0.0, 1e3):
        controller = eqx.tree_at(lambda c: c.anti_windup, pid(), jnp.array(rate))
        samples = run(around(controller, p753.plant()), reference)[1]
        late.append(np.mean((samples.voltage == 120.0) & (reference[:, :-1] < 16.0)))
    assert late[1] < 0.1 * late[0]


def test_unit_weights_give_the_pid_of_the_error():
    def plain(state, seen):
        """The PID without weights, from its equations."""
        integral, rate, last, command = state
        error = seen.reference - seen.measured
        gains = PID_GAINS
        integral = integral + p753.DT * (
            gains["anti_windup"] * (seen.applied - command) + gains["I"] * error
        )
        slope = (error - last) / p753.DT
        smoothing = p753.DT / (p753.DT + gains["derivative_filter"])
        rate = rate + smoothing * (slope - rate)
        command = gains["P"] * error + integral + gains["D"] * rate
        return (integral, rate, error, command), command

    seen = Observation(*np.random.default_rng(4).normal(size=(4, 500)))
    first = Observation(*(float(values[0]) for values in seen))
    controller = pid()
    state, found = controller.init(first), []
    for sample in zip(*seen, strict=True):
        state, command = controller.step(state, Observation(*sample))
        found.append(float(command))
    error = first.reference - first.measured
    state = (first.applied - PID_GAINS["P"] * error, 0.0, error, first.applied)
    expected = []
    for sample in zip(*seen, strict=True):
        state, command = plain(state, Observation(*sample))
        expected.append(command)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)
    assert vars(weighted_pid(1.0, 1.0)).keys() == vars(controller).keys()
    for name, value in vars(controller).items():
        assert getattr(weighted_pid(1.0, 1.0), name) == value


def test_weights_do_not_change_the_response_to_noise():
    """At a reference of zero the weights have no effect."""
    references = np.zeros((1, SAMPLES + 1))
    loops = [around(c, p753.plant()) for c in (pid(), weighted_pid(50.0, -20.0))]
    one, other = (run(loop, references)[1].displacement for loop in loops)
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("weights", [(50.0, 1.0), (1.0, -20.0), (0.0, 0.0)])
def test_a_weighted_pid_stays_at_rest(weights):
    loop = around(weighted_pid(*weights), p753.plant())
    inputs = LoopInput(jnp.full(200, 5.0), jnp.zeros(200))
    samples = simulate(loop, inputs, loop.init(5.0))[1]
    np.testing.assert_allclose(samples.displacement, 5.0, rtol=0.0, atol=1e-9)


def observed(observer, measured):
    zero = jnp.zeros(len(measured))
    seen = Observation(zero, zero, jnp.asarray(measured), zero)
    rest = Observation(*map(jnp.asarray, (0.0, 0.0, 0.0, 0.0)))
    return simulate(observer, seen, observer.init(rest))[1]


def test_alpha_beta_equals_the_published_filter():
    measured = np.cumsum(DRAWS)[:2000]
    oracle = control.AlphaBeta(0.1, 1e-4, p753.DT)
    expected = np.array([oracle.step(z) for z in measured])
    found = observed(AlphaBeta(0.1, 1e-4, p753.DT), measured)
    np.testing.assert_allclose(found.position, expected[:, 0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.velocity, expected[:, 1], rtol=1e-9, atol=1e-6)


def test_q_filter_equals_the_published_one():
    for name, corrected in (("corrected", True), ("printed", False)):
        controller = p753.disturbance_observer(coefficients=name)
        expected = control.q_filter(
            controller.model.moving, 500.0, p753.RATE, corrected
        )
        np.testing.assert_allclose(controller.denominator(), expected, rtol=1e-12)


def test_corrected_q_filter_has_its_double_pole_at_the_cut_off():
    controller = p753.disturbance_observer()
    wt = 500.0 * p753.DT
    mapped = (2.0 - wt) / (2.0 + wt)  # bilinear transform of -cutoff
    c = np.array(controller.denominator())
    np.testing.assert_allclose(c[1:] / c[0], [-2.0 * mapped, mapped**2], rtol=1e-9)
    np.testing.assert_allclose(c.sum(), sum(controller.model.moving), rtol=1e-9)


DT = p753.DT
SECOND_ORDER = p753.disturbance_observer().model
FIRST_ORDER = ARMA((0.5,), (0.5,))


def sliding_mode(**changes):
    parameters = {
        "law": SwitchingPID(0.01, 30.0, 1e-6, dt=DT),
        "surface": 18e3,
        "error_weight": 1.0,
        "control_weight": 100.0,
        "model": SECOND_ORDER,
        "filter": AlphaBeta(0.1, 1e-4, DT),
    }
    return SlidingMode(**{**parameters, **changes})


def observer(model=SECOND_ORDER, gain=0.1, cutoff=500.0, dt=DT, **options):
    return DisturbanceObserverControl(pid(), model, gain, cutoff, dt, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PID(1.0, 1.0, dt=0.0), "dt in s is 0; it must be finite"),
        (
            lambda: PID(1.0, 1.0, derivative_filter=-1e-4, dt=DT),
            "derivative_filter in s is -0.0001; it must be finite and at least 0",
        ),
        (
            lambda: PID(1.0, 1.0, anti_windup=-1.0, dt=DT),
            "anti_windup in 1/s is -1; it must be finite and at least 0",
        ),
        (
            lambda: weighted_pid(np.inf, 1.0),
            "proportional_weight is inf; it must be finite",
        ),
        (
            lambda: weighted_pid(1.0, np.nan),
            "derivative_weight is nan; it must be finite",
        ),
        (
            lambda: sliding_mode(model=ARMA((), (0.5,))),
            "the model has no coefficient a_1; it must have one",
        ),
        (
            lambda: sliding_mode(error_weight=0.0),
            "error_weight is 0; it must be finite and above 0",
        ),
        (
            lambda: sliding_mode(control_weight=-1.0),
            "control_weight is -1; it must be finite and at least 0",
        ),
        (lambda: AlphaBeta(0.0, 0.1, DT), "alpha is 0; it must be finite and above 0"),
        (lambda: AlphaBeta(1.1, 0.1, DT), r"alpha is 1\.1; .* at most 1"),
        (lambda: AlphaBeta(0.1, 2.0, DT), "beta is 2; it must be finite and at least"),
        (lambda: AlphaBeta(0.1, 0.1, -DT), "dt in s is -5e-05"),
        (
            lambda: sliding_mode(model=FIRST_ORDER, surface=0.0),
            "surface is 0; it must be another number",
        ),
        (
            lambda: observer(ARMA((), (0.5,))),
            "the model is a gain; it must have an order of at least 1",
        ),
        (
            lambda: observer(FIRST_ORDER, coefficients="printed"),
            "the model has the order 1; printed coefficients need 2",
        ),
        (lambda: observer(gain=0.0), "gain in um/V is 0; it must be finite and"),
        (
            lambda: observer(cutoff=7e4),
            "cutoff in rad/s is 70000; it must be finite and above 0 and below 62831",
        ),
        (lambda: observer(dt=0.0), "dt in s is 0"),
        (
            lambda: observer(coefficients="right"),
            "coefficients 'right'; it must be one of .*'corrected', 'printed'",
        ),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PID(np.nan, 1.0, dt=DT), "proportional.* is nan; it must be finite"),
        (lambda: sliding_mode(surface=np.inf), "surface.* is inf; it must be finite"),
        (lambda: sliding_mode(model=ARMA((0.5, 0.1), (0.0, 0.1, 0.1))), "b_0"),
        (lambda: observer(ARMA((0.5, 0.1), (1.0, -2.0, 1.0))), "DC gain"),
    ],
)
def test_parameters_that_give_nan_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
