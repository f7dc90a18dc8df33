"""Loops of vendors against NumPy loops, and the rounding of their parameters."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import vendor_loops

import piezojax as pj
from piezojax.control import E727, NV200, PyRPL, Servo, Stabilizer
from piezojax.core.serial import from_data, to_data
from piezojax.core.system import Affine, resolve
from piezojax.report.tuning_tables import gains_table
from piezojax.study import Study, build
from piezojax.tuning.device_alarms import device_alarms

DT, SAMPLES, SPAN = 5e-5, 500, (-20.0, 130.0)
RANGE = {"avmin": -20.0, "avmax": 130.0, "posmin": 0.0, "posmax": 80.0}
SCALE = 150.0 / 80.0
REST = 12.0

NV200S = {
    "integral": {"ki": 70.0},
    "trapezoidal": {"ki": 70.0, "integration": "trapezoidal"},
    "half": {"ki": 70.0, "kp": 0.02, "integration": "half"},
    "pid": {"kp": 0.021, "ki": 40.0, "kd": 3e-3, "scale": 0.9},
    "filters": {
        **{"kp": 0.02, "ki": 60.0, "setlpon": 1, "setlpf": 700.0},
        **{"poslpon": 1, "poslpf": 1234.5, "notchon": 1, "notchf": 811.0},
        **{"notchb": 400.0, "notch_depth": 0.1},
    },
    "equal poles": {"ki": 50.0, "setlpon": 1, "setpoint_filter": "equal poles"},
    "slew": {"ki": 100.0, "sr": 0.9, "setlpon": 1},
    "feedforward": {"ki": 30.0, "pcf_x": 0.5, "pcf_v": 1e-3, "pcf_a": 0.2},
    "windup": {"ki": 900.0, "kp": 0.5, "anti_windup": "hold"},
}
E727S = {
    "integral": {"proportional": 0.02, "integral_time": 2e-4},
    "off": {"proportional": 0.3, "integral_time": 0.0},
    "parallel": {
        **{"proportional": 0.1, "integral_time": 8e-3, "derivative_time": 1e-5},
        "structure": "parallel",
    },
    "notches": {
        **{"proportional": 0.05, "integral_time": 5e-4, "derivative_time": 2e-5},
        **{"notch_frequency_1": 800.0, "notch_rejection_1": 0.05},
        **{"notch_frequency_2": 2100.0, "notch_rejection_2": 0.2},
        "notch_bandwidth_2": 0.4,
    },
    "held notch": {
        **{"proportional": 0.05, "integral_time": 5e-4, "notch_method": 1},
        **{"notch_frequency_1": 800.0, "notch_rejection_1": 0.05},
        "notch_bandwidth_1": 0.7,
    },
    "windup": {
        **{"proportional": 3.0, "integral_time": 2e-3, "anti_windup": "hold"},
    },
    "filter and slew": {
        **{"proportional": 0.05, "integral_time": 5e-4, "filter_type": 1},
        **{"filter_frequency": 900.0, "slew_rate": 2000.0},
    },
}
SERVOS = {
    "parallel": {"proportional": 0.3, "integral": 500.0, "derivative": 1e-5},
    "standard": {
        **{"proportional": 0.3, "integral": 2e-3, "derivative": 1e-4},
        "form": "standard",
    },
    "everything": {
        **{"proportional": 0.2, "integral": 300.0, "feedforward": 1.1},
        **{"notch_frequency_1": 780.0, "notch_width_1": 300.0, "notch_depth_1": 0.05},
        **{"notch_frequency_2": 2500.0, "notch_width_2": 900.0, "notch_depth_2": 0.3},
        **{"low_pass": 4000.0, "low_pass_order": 2, "slew_rate": 3000.0},
    },
    "windup": {
        **{"proportional": 1.0, "integral": 6000.0, "feedforward": 0.5},
        **{"notch_frequency_1": 780.0, "notch_width_1": 300.0, "notch_depth_1": 0.2},
        "anti_windup": "hold",
    },
    "first order": {
        **{"proportional": 0.2, "integral": 300.0, "low_pass": 3000.0},
        "low_pass_order": 1,
    },
}


STABILIZERS = {
    "integral": {"p": -1e-3, "i": 400.0},
    "pid": {"p": -0.4, "i": 300.0, "d": 2e-6, "limit_d": 20.0},
    "leaking": {"p": -0.4, "i": 300.0, "limit_i": 50.0},
    "reversed": {"p": 0.1, "i": 40.0},
    "limited": {"p": -2.0, "i": 9000.0, "minimum": -3.0, "maximum": 6.0},
}
RED_PITAYAS = {
    "integral": {"p": 0.0, "i": -60.0},
    "both": {"p": -0.3333, "i": -20.0013},
    "filters": {
        **{"p": -0.2, "i": -30.0, "filters": 2},
        **{"filter_1": 1500.0, "filter_2": 4000.0},
    },
    "limited": {"p": -1.5, "i": -900.0, "min_voltage": -0.7, "max_voltage": 0.9},
    "far": {"p": 0.0, "i": -3e4},
}
WIRES = {"sensor_gain": 0.1, "amplifier_gain": 15.0, "offset": 55.0}
PITAYA = {"sensor_gain": 0.012, "amplifier_gain": 75.0, "offset": 55.0}


def nv200(**options):
    return NV200(**RANGE, **options)


def e727(**options):
    return E727(**options, scale=2.5, lower=SPAN[0], upper=SPAN[1])


def servo(**options):
    return Servo(**options, lower=SPAN[0], upper=SPAN[1], dt=DT)


def stabilizer(**options):
    return Stabilizer(**options, **WIRES)


def pyrpl(**options):
    return PyRPL(**options, **PITAYA, dt=DT)


def expected_nv200(**options):
    limits = {"lower": SPAN[0], "upper": SPAN[1], "stroke": 80.0}
    named = {"setpoint_filter": "low_pass", "notch_depth": "depth"}
    given = {"setlpf": 200.0, "scale": SCALE} | options
    given = {named.get(name, name): value for name, value in given.items()}
    return vendor_loops.NV200(REST, REST, 30.0, **limits, **given)


def expected_e727(**options):
    names = {"proportional": "P", "integral_time": "I", "derivative_time": "D"}
    names |= {"notch_method": "method", "slew_rate": "slew"}
    given = {names.get(name, name): value for name, value in options.items()}
    return vendor_loops.E727(
        *(REST, REST, 30.0), scale=2.5, lower=SPAN[0], upper=SPAN[1], **given
    )


def expected_servo(**options):
    standard = options.get("form") == "standard"
    names = {"proportional": "gain", "integral": "ti", "derivative": "td"}
    if not standard:
        names = {"proportional": "kp", "integral": "ki", "derivative": "kd"}
    names |= {"low_pass": "low_pass_frequency", "slew_rate": "slew"}
    given = {names.get(name, name): value for name, value in options.items()}
    return vendor_loops.GenericServo(
        *(REST, REST, 30.0), dt=DT, lower=SPAN[0], upper=SPAN[1], **given
    )


def expected_stabilizer(**options):
    wires = {"sensor": 0.1, "volts": 15.0, "offset": 55.0}
    return vendor_loops.Stabilizer(REST, REST, 30.0, **wires, **options)


def expected_pyrpl(**options):
    named = {"min_voltage": "minimum", "max_voltage": "maximum"}
    given = {named.get(name, name): value for name, value in options.items()}
    count = given.pop("filters", 0)
    cutoffs = [given.pop(f"filter_{n + 1}") for n in range(count)]
    wires = {"sensor": 0.012, "volts": 75.0, "offset": 55.0, "dt": DT}
    return vendor_loops.RedPitaya(REST, REST, 30.0, cutoffs=cutoffs, **wires, **given)


CASES = {
    f"{make.__name__} {name}": (make, oracle, options)
    for make, oracle, table in (
        (nv200, expected_nv200, NV200S),
        (e727, expected_e727, E727S),
        (servo, expected_servo, SERVOS),
        (stabilizer, expected_stabilizer, STABILIZERS),
        (pyrpl, expected_pyrpl, RED_PITAYAS),
    )
    for name, options in table.items()
}


@jax.jit
def commands(controller, references, measurements):
    """Return the commands of a controller that starts at rest."""

    def step(state, now):
        seen = pj.Observation(now[0], now[0], now[1], 30.0)
        return controller.step(state, seen)

    rest = pj.Observation(REST, REST, REST, 30.0)
    return jax.lax.scan(step, controller.init(rest), (references, measurements))[1]


@pytest.mark.parametrize("case", CASES)
def test_a_device_equals_the_loop_of_its_equations(case):
    make, oracle, options = CASES[case]
    random = np.random.default_rng(7)
    references = REST + 25.0 * (np.arange(SAMPLES) > 20) * (np.arange(SAMPLES) < 260)
    # measurements of a slow stage, with noise
    slow = np.convolve(references, np.exp(-np.arange(SAMPLES) / 60.0) / 60.5)[:SAMPLES]
    measurements = slow + REST * np.exp(-np.arange(SAMPLES) / 60.0)
    measurements = measurements + 0.05 * random.normal(size=SAMPLES)
    signals = jnp.asarray(references), jnp.asarray(measurements)
    found = commands(make(**options), *signals)
    independent = oracle(**options)
    expected = [
        independent.step(*now) for now in zip(references, measurements, strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    if "hold" in options.values():
        assert 10 < np.sum(np.isin(expected, SPAN)) < SAMPLES - 50


def test_an_nv200_rounds_to_three_decimals_and_whole_frequencies():
    typed = nv200(kp=0.0204, ki=70.0004, notchf=811.4, notchb=399.6, notchon=1)
    exact = nv200(kp=0.02, ki=70.0, notchf=811.0, notchb=400.0, notchon=1)
    signals = REST + np.arange(50.0), np.full(50, REST)
    np.testing.assert_array_equal(commands(typed, *signals), commands(exact, *signals))
    assert float(typed.typed().kp) == 0.02
    assert float(typed.kp) == 0.0204


def test_rounding_keeps_the_notch_within_its_limit():
    notch = nv200(notchf=100.4, notchb=200.8, notchon=1).typed()
    assert (float(notch.notchf), float(notch.notchb)) == (100.0, 200.0)


def test_pyrpl_rounds_to_its_registers():
    typed = pyrpl(p=-0.12345, i=-20.0, filters=1, filter_1=1500.0).typed()
    assert float(typed.p) * 2**12 == round(-0.12345 * 2**12)
    assert float(typed.i) == pytest.approx(-20.0, abs=2.4e-3)
    # 125 MHz / 2 pi over 2^14; the gradient is that of the unrounded value.
    assert float(typed.filter_1) == pytest.approx(1214.3, abs=0.1)
    slope = jax.grad(lambda f: pyrpl(p=0.0, i=1.0, filter_1=f).typed().filter_1)
    assert slope(1500.0) == 1.0


def test_pyrpl_has_no_cut_off_above_19_9_mhz():
    typed = pyrpl(p=0.0, i=1.0, filter_1=30e6).typed()
    assert float(typed.filter_1) == pytest.approx(125e6 / (2.0 * np.pi))


def test_a_filter_of_pyrpl_that_is_on_lies_below_half_the_rate():
    def on(frequency):
        return PyRPL(p=0.0, i=1.0, filters=1, filter_1=frequency, **PITAYA, dt=1 / 3e4)

    # 19.4 kHz is the nearest cut-off, but the simulation ends at 15 kHz.
    assert float(on(14.9e3).typed().filter_1) == pytest.approx(125e6 / 2**12 / np.pi)
    assert float(on(14.9e3).typed().filter_1) < 15e3
    with pytest.raises(ValueError, match=r"filter_1 is 15000; .* below 15000"):
        on(15e3)
    assert float(pyrpl(p=0.0, i=1.0, filter_1=15e3).filter_1) == 15e3  # off


def test_a_stabilizer_ignores_small_errors():
    """At 8 V the steps of single precision are 2^-9 codes: smaller errors vanish."""
    slow = stabilizer(p=-1e-6, i=1.0)
    measured = np.full(400, REST)
    rest = pj.Observation(REST, REST, REST, 55.0 + 15.0 * 8.0)

    def last(error):
        def step(state, measured):
            seen = pj.Observation(REST + error, REST + error, measured, 30.0)
            return slow.step(state, seen)

        state = slow.init(rest)
        return float(jax.lax.scan(step, state, measured)[1][-1]) - 175.0

    exact = 15.0 * 0.1 * 1.28e-6 * 400
    assert last(20.0) == pytest.approx(20.0 * exact, rel=0.2)
    assert last(1.0) == 0.0


def test_a_servo_at_a_low_rate_checks_active_filters_only():
    limits = {"lower": -1e6, "upper": 1e6, "dt": 1e-3}
    plain = Servo(1.0, 100.0, notch_frequency_2=800.0, **limits)
    assert float(plain.notch_frequency_1) == 1000.0
    references, measured = REST + np.arange(2000.0), np.full(2000, REST)
    # P = 1 and I dt = 0.1; the filters that are off have no hidden unstable mode.
    error = references - REST
    expected = 30.0 + error + 0.1 * np.cumsum(error)
    for device in (resolve(plain), plain):
        found = commands(device, references, measured)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    with pytest.raises(ValueError, match=r"notch_frequency_1 is 1000; .* below 500"):
        Servo(1.0, 100.0, notch_depth_1=0.5, **limits)


def test_the_gradient_ignores_the_rounding():
    signals = REST + np.arange(50.0), np.full(50, REST)

    def last(ki):
        return commands(nv200(ki=ki), *signals)[-1]

    slope = jax.grad(last)(70.0004)
    quotient = (last(71.0) - last(69.0)) / 2.0
    assert float(slope) == pytest.approx(float(quotient), rel=1e-9)


def test_a_device_is_saved_and_loaded():
    for make, _, options in CASES.values():
        device = make(**options)
        data = json.loads(json.dumps(to_data(device)))
        assert to_data(from_data(data)) == data


STUDY = {
    "title": "an NV200 on a lag",
    "rate": 20_000.0,
    "plant": {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": DT},
    "actuator": {"lower": -20.0, "upper": 130.0},
    "controller": {"type": "NV200", "kp": 0.01, "ki": 20.0, **RANGE},
    "references": {
        **{"tune": ["SW50"], "amplitude": 20.0, "offset": 20.0},
        **{"duration": 0.05, "settle": 0.01},
    },
    "tune": ["controller.kp", "controller.ki"],
    "optimiser": {"method": "gauss_newton", "starts": 1, "candidates": 4, "steps": 3},
}


def test_a_study_tunes_the_values_of_the_device():
    outcome = pj.tune(build(Study.model_validate(STUDY), "study.toml"))
    gains = outcome.result.gains
    for value in gains.values():
        assert value == round(value, 3)
    before, after = outcome.result.holdout_before, outcome.result.holdout
    assert after.geomean_rms_um < 0.5 * before.geomean_rms_um
    assert float(outcome.controller.ki) == gains["controller.ki"]
    (alarm,) = outcome.result.alarms
    assert alarm.startswith("the scale of the gains of the NV200 is assumed, 1.875 V")
    rows = [*gains_table(outcome.result).columns[2].cells]
    assert rows == [f"{value:.3f}" for value in gains.values()]


def test_a_structure_that_is_not_stated_raises_an_alarm():
    gains = {"proportional": 0.02, "integral_time": 2e-4}
    (alarm,) = device_alarms(e727(**gains))
    assert alarm.startswith("the structure of the PID of the E-727 is assumed")
    assert "integral and derivative may act 50 times as strongly" in alarm
    assert "identify RECORD --controller e727) and set controller.structure" in alarm
    for structure in ("series", "parallel"):
        assert list(device_alarms(e727(**gains, structure=structure))) == []
    # Models saved before name the structure that was simulated, or none.
    data = to_data(e727(**gains, structure="series"))
    assert from_data(data).structure == "series"
    del data["structure"]
    assert from_data(data).cautions == (alarm,)


def test_a_measured_scale_raises_no_alarm():
    assert list(device_alarms(nv200(scale=2.0))) == []
    inner = pj.control.FilteredCommand(nv200(), Affine())
    assert len(list(device_alarms(inner))) == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nv200(kp=2e4), "kp is 20000; it must be finite and .* at most 10000"),
        (
            lambda: nv200(notchf=100.0, notchb=300.0),
            "notchb is 300 and 2 notchf is 200",
        ),
        (lambda: nv200(integration="tustin"), "integration is 'tustin'; .* half"),
        (lambda: nv200(anti_windup="clamp"), "anti_windup is 'clamp'; .* none, hold"),
        (lambda: nv200(setpoint_filter="bessel"), "setpoint_filter is 'bessel'"),
        (lambda: nv200(dt=1e-4), "dt is 0.0001 s; NV200 runs at 20 kHz"),
        (lambda: e727(proportional=0.0, integral_time=1.0), "proportional is 0"),
        (lambda: pyrpl(p=3e3, i=0.0), "p in V/V is 3000; it must be .* at most 2048"),
        (lambda: pyrpl(p=0.0, i=0.0, filters=5), "filters is 5"),
        (lambda: pyrpl(p=0.0, i=0.0, min_voltage=0.5, max_voltage=0.2), "min_voltage"),
        (lambda: stabilizer(p=1.0, i=-2.0), r"i in V/\(V s\) is -2; it must be"),
        (lambda: stabilizer(p=1.0, i=1.0, minimum=3.0, maximum=2.0), "minimum is 3"),
        (lambda: e727(proportional=1.0, integral_time=1.0, notch_method=2), "0, 1"),
        (lambda: e727(proportional=1.0, integral_time=1.0, filter_type=99), "0, 1"),
        (lambda: e727(proportional=1.0, integral_time=1.0, structure="x"), "structure"),
        (
            lambda: servo(proportional=1.0, integral=1.0, form="ideal"),
            "form is 'ideal'",
        ),
        (lambda: servo(proportional=1.0, integral=1.0, low_pass_order=3), "0, 1, 2"),
    ],
)
def test_values_that_are_not_allowed_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        commands(make(), REST + np.arange(3.0), np.full(3, REST))


def test_a_study_of_another_rate_is_refused():
    plant = STUDY["plant"] | {"dt": 1e-4}
    study = Study.model_validate(STUDY | {"rate": 10_000.0, "plant": plant})
    with pytest.raises(ValueError, match="rate is 10000 Hz, but the controller"):
        build(study, "study.toml")
