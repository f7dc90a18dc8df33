"""Electronics of a study: each entry, against a loop in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from piezojax import simulate, stability_report
from piezojax.analysis.limit import performance_limit
from piezojax.analysis.stability import sensitivity_peak
from piezojax.core.feedback import loop_inputs
from piezojax.core.paths import get, parameters, replace
from piezojax.core.system import Series
from piezojax.dynamics import FirstOrderLag
from piezojax.study import Study, build
from piezojax.study.tables import validated

RATE = 2e4
DT = 1.0 / RATE
TAU, INTEGRAL = 4e-4, 900.0

STUDY = {
    "title": "an integral controller on a lag",
    "rate": RATE,
    "plant": {"type": "FirstOrderLag", "time_constant": TAU, "dt": DT},
    "actuator": {"lower": -4.0, "upper": 20.0},
    "controller": {"type": "PID", "proportional": 0.0, "integral": INTEGRAL, "dt": DT},
    "references": {"tune": ["SW50"], "duration": 0.02, "settle": 0.0},
    "parameters": {"controller.integral": {"lower": 30.0, "upper": 3e3}},
}
LINEAR = {
    "actuator": {"bandwidth": 2000.0, "order": 2, "delay": 3e-5, "computation": 1.3},
    "sensor": {"bandwidth": 1200.0, "order": 3, "delay": 2e-5, "anti_aliasing": 6e3},
}
OTHER = {
    "actuator": {"bits": 10, "capacitance": 2e-6, "current_limit": 0.02},
    "sensor": {"bits": 12, "range": 30.0, "noise_rms": 0.05},
}


def tables(*changes):
    found = {name: dict(STUDY.get(name, {})) for name in ("actuator", "sensor")}
    for change in changes:
        for name, entries in change.items():
            found[name] |= entries
    return STUDY | found


def case_of(*changes, **more):
    return build(Study.model_validate(tables(*changes) | more), "small.toml")


def filtered(bandwidth, order):
    """Return a low-pass as a function of one input at a time, from rest at 0."""
    analog = signal.butter(order, 2.0 * np.pi * bandwidth, analog=True, output="zpk")
    A, B, C, D = signal.cont2discrete(signal.zpk2ss(*analog), DT, "foh")[:4]
    state = np.zeros(len(A))

    def step(value):
        nonlocal state
        output = (C @ state + D[:, 0] * value)[0]
        state = A @ state + B[:, 0] * value
        return output

    return step


def delayed(samples):
    """Return a delay that is linear between samples, from rest at 0."""
    past = [0.0] * 16

    def step(value):
        past.insert(0, value)
        whole, share = int(samples), samples - int(samples)
        return (1.0 - share) * past[whole] + share * past[whole + 1]

    return step


def cubic(samples):
    """Return four ages in samples, and their weights in the cubic at ``samples``."""
    ages = np.arange(4.0) + max(0, int(samples) - 1)
    return ages, np.linalg.solve(np.vander(ages).T, np.vander([samples], 4)[0])


def delayed_by_cubics(samples):
    """Return a delay that is cubic between samples, from rest at 0."""
    past = [0.0] * 16
    ages, weights = cubic(samples)

    def step(value):
        past.insert(0, value)
        return sum(w * past[int(age)] for w, age in zip(weights, ages, strict=True))

    return step


def numpy_loop(reference, draws):
    """Return displacement and voltage with LINEAR and OTHER, in plain Python."""
    late, smooth = delayed(1.3 + 3e-5 / DT), filtered(2000.0, 2)
    sensed, sensed_late = filtered(1200.0, 3), delayed_by_cubics(2e-5 / DT)
    against_aliasing = filtered(6e3, 1)
    most = 0.02 / 2e-6 * DT
    y = integral = slewed = 0.0
    pole = np.exp(-DT / TAU)
    moved, voltages = [], []
    for r, draw in zip(reference, draws, strict=True):
        moved.append(y)
        measured = against_aliasing(sensed_late(sensed(y)) + 0.05 * draw)
        step = 30.0 / 2**12
        integral += DT * INTEGRAL * (r - step * np.round(measured / step))
        # Steps -171 and 854 of the converter are beyond the limits, -4 and 20 V.
        step = 24.0 / 2**10
        clipped = min(max(integral, -170.0 * step), 853.0 * step)
        slewed += min(max(clipped - slewed, -most), most)
        voltages.append(step * np.round(slewed / step))
        y = pole * y + (1.0 - pole) * smooth(late(voltages[-1]))
    return np.array(moved), np.array(voltages)


def test_all_hardware_in_a_loop_equals_numpy():
    loop = case_of(LINEAR, OTHER).loop
    random = np.random.default_rng(4)
    reference = np.repeat(random.uniform(0.0, 16.0, 8), 100)
    reference[0] = 0.0
    draws = random.standard_normal(800)
    log = simulate(
        loop, loop_inputs(jnp.asarray(reference), jnp.asarray(draws)), loop.init(0.0)
    )[1]
    displacement, voltage = numpy_loop(reference, draws)
    np.testing.assert_allclose(log.voltage, voltage, atol=1e-9)
    np.testing.assert_allclose(log.displacement, displacement, atol=1e-9)
    rises = np.abs(np.diff(voltage))
    assert np.sum(rises > 0.95 * 0.02 / 2e-6 * DT) > 20  # the current limit acts


def written(angle):
    """Return L at ``angle`` (rad/sample) with LINEAR, by transfer functions."""
    z = np.exp(1j * angle)

    def low_pass(bandwidth, order):
        analog = signal.butter(
            order, 2.0 * np.pi * bandwidth, analog=True, output="zpk"
        )
        matrices = signal.cont2discrete(signal.zpk2ss(*analog), DT, "foh")[:4]
        numerator, denominator = signal.ss2tf(*matrices)
        return signal.freqz(numerator[0], denominator, worN=angle)[1]

    def delay(samples):
        whole, share = int(samples), samples - int(samples)
        return (1.0 - share) * z**-whole + share * z ** -(whole + 1.0)

    def delay_by_cubics(samples):
        ages, weights = cubic(samples)
        return sum(w * z**-age for w, age in zip(weights, ages, strict=True))

    pole = np.exp(-DT / TAU)
    plant = (1.0 - pole) / (z - pole)
    controller = INTEGRAL * DT * z / (z - 1.0)
    amplifier = low_pass(2000.0, 2) * delay(1.3 + 3e-5 / DT)
    sensor = low_pass(1200.0, 3) * delay_by_cubics(2e-5 / DT) * low_pass(6e3, 1)
    return plant * controller * amplifier * sensor


def test_margins_include_the_electronics():
    loop = case_of(LINEAR).loop
    report = stability_report(loop, 3.0)
    angle = np.linspace(1e-4, np.pi, 400_000)
    L = written(angle)
    S = np.abs(1.0 / (1.0 + L))
    assert report.sensitivity_peak == pytest.approx(S.max(), rel=1e-6)
    falls = np.abs(L) < 1.0
    assert np.sum(falls[1:] != falls[:-1]) == 1
    around = slice(np.argmax(falls) - 1, np.argmax(falls) + 1)
    place = np.interp(0.0, -np.log(np.abs(L[around])), angle[around])
    lag = np.interp(place, angle[around], np.mod(np.angle(L[around]), 2.0 * np.pi))
    margin = (lag - np.pi) / place
    assert report.delay_margin_samples == pytest.approx(margin, rel=1e-6)
    assert float(sensitivity_peak(loop, 3.0)) == pytest.approx(S.max(), rel=2e-3)
    # Without the electronics the margins differ.
    bare = stability_report(case_of().loop, 3.0)
    assert bare.sensitivity_peak < 0.9 * report.sensitivity_peak


def test_converters_do_not_change_the_margins():
    """The DAC cannot hold the reference exactly: 3.14159 is between two steps."""
    coarse = {"actuator": {"bits": 8}, "sensor": {"resolution": 0.01}}
    smooth, rounded = (
        stability_report(case_of(LINEAR, *changes).loop, 3.14159)
        for changes in ((), (coarse,))
    )
    assert rounded.sensitivity_peak == pytest.approx(smooth.sensitivity_peak, rel=1e-9)
    assert rounded.voltage_V == pytest.approx(3.14159, rel=1e-9)


def test_gradients_by_the_hardware_equal_finite_differences():
    loop = case_of(LINEAR).loop
    paths = [
        "plant.amplifier.low_pass.bandwidth",
        "plant.amplifier.delay.delay",
        "sensor.response.dynamics.low_pass.bandwidth",
        "sensor.anti_aliasing.bandwidth",
    ]
    inputs = loop_inputs(3.0 + jnp.sin(0.05 * jnp.arange(60)))

    @jax.jit
    def loss(values):
        changed = replace(loop, dict(zip(paths, values, strict=True)))
        log = simulate(changed, inputs, changed.init(3.0))[1]
        return (log.displacement**2).sum()

    values = np.array([float(get(loop, path)) for path in paths])
    slopes = np.asarray(jax.grad(loss)(values))
    for i, value in enumerate(values):
        step = np.zeros(4)
        step[i] = 1e-5 * value
        expected = float(loss(values + step) - loss(values - step)) / (2e-5 * value)
        assert slopes[i] == pytest.approx(expected, rel=1e-5)


def test_a_study_without_electronics_has_the_same_systems():
    loop = case_of().loop
    assert isinstance(loop.plant, FirstOrderLag)
    assert loop.actuator.names == ("limits",)
    assert loop.sensor.names == ("noise",)
    assert case_of().amplifier is None


def test_paths_of_the_plant_do_not_change():
    plant = {
        "type": "Series",
        "parts": [{"type": "Affine", "gain": 0.2}, STUDY["plant"]],
        "names": ["gain", "dynamics"],
    }
    loop = case_of(LINEAR, plant=plant).loop
    assert loop.plant.names == ("amplifier", "gain", "dynamics")
    del plant["names"]
    loop = case_of(LINEAR, plant=plant).loop
    assert "plant.1.time_constant" in parameters(loop)
    loop = case_of(LINEAR).loop
    assert isinstance(loop.plant, Series)
    assert float(get(loop, "plant.stage.time_constant")) == TAU


def test_plants_of_an_ensemble_keep_the_amplifier():
    case = case_of(
        {"actuator": {"bandwidth": 500.0, "delay": 1e-4}},
        plant={"catalog": "p753_stage"},
        controller={"catalog": "p753_pid"},
        ensemble={
            "spread": {"gain": 0.1, "plant.amplifier.delay.delay": 1.0},
            "holdout": 3,
        },
    )
    stages = case.ensemble.stages("holdout")
    bandwidth = stages.plant.parts[0].parts[1].bandwidth
    np.testing.assert_array_equal(bandwidth, 500.0)
    delays = np.asarray(stages.plant.parts[0].parts[0].delay)
    assert np.unique(delays).size == 3
    assert np.all(delays <= stages.plant.parts[0].parts[0].longest * DT)


@pytest.mark.parametrize(
    ("table", "bound"),
    [
        ({"spread": {"plant.amplifier.delay.delay": 1.5}}, "at least 0"),
        ({"range": {"plant.amplifier.delay.delay": [0.0, 2.5e-4]}}, "at most 0.0002"),
    ],
)
def test_an_ensemble_beyond_the_limits_of_a_part_is_refused(table, bound):
    message = rf"ensemble.*amplifier.delay.delay: delay in s is .*{bound}"
    with pytest.raises(ValueError, match=message):
        case_of({"actuator": {"delay": 1e-4}}, ensemble=table)


AXES = {
    "axes": {"names": ["x", "y"], "units": ["um", "um"]},
    "plant": {
        "type": "PerAxis",
        "parts": [STUDY["plant"], STUDY["plant"]],
        "names": ["x", "y"],
    },
    "controller": {
        "type": "PerAxis",
        "parts": [STUDY["controller"], STUDY["controller"]],
        "names": ["x", "y"],
    },
    "references": STUDY["references"] | {"tune": ["x:SIN50"]},
    "parameters": {"controller.x.integral": {"lower": 30.0, "upper": 3e3}},
}


def test_every_entry_may_differ_by_axis():
    case = case_of(
        {
            "actuator": {"delay": [0.0, 1e-4], "slew_rate": [1e3, 2e3], "bits": 8},
            "sensor": {"bandwidth": [300.0, 600.0], "resolution": [0.01, 0.02]},
        },
        **AXES,
    )
    loop = case.loop
    assert float(get(loop, "plant.amplifier.y.delay.delay")) == pytest.approx(1e-4)
    assert case.amplifier.parts[0].parts == ()
    assert float(get(loop, "actuator.y.slew.rate")) == 2e3
    assert float(get(loop, "actuator.x.converter.resolution")) == 24.0 / 2**8
    assert float(get(loop, "sensor.x.response.dynamics.low_pass.bandwidth")) == 300.0
    assert float(get(loop, "sensor.y.converter.resolution")) == 0.02


def test_the_lower_slew_rate_applies():
    current = {"current_limit": 0.01, "capacitance": 1e-6}
    for rate, expected in ((5e3, 5e3), (2e4, 1e4)):
        case = case_of({"actuator": {"slew_rate": rate, **current}})
        assert float(get(case.loop, "actuator.slew.rate")) == pytest.approx(expected)


@pytest.mark.parametrize(
    "entries",
    [
        {"lower": -20.0, "upper": 120.0, "bits": 16},
        {"lower": -4.0, "upper": 20.0, "bits": 10, "slew_rate": 1e5},
        {"lower": 0.1, "upper": 0.9, "resolution": 0.25},
        {"lower": 0.0, "upper": 120.0, "bits": 12},
        {"lower": -0.3, "upper": 0.3, "resolution": 0.1},
    ],
)
def test_a_converter_does_not_exceed_the_limits(entries):
    actuator = case_of({"actuator": entries}).loop.actuator
    lower, upper = entries["lower"], entries["upper"]
    span = upper - lower
    step = entries.get("resolution") or span / 2 ** entries["bits"]
    commands = lower + span * np.linspace(-1.0, 2.0, 200).repeat(50)
    voltage = simulate(actuator, jnp.asarray(commands), actuator.init(lower))[1]
    voltage = np.asarray(voltage)
    assert lower - 1e-12 <= voltage.min() < lower + step
    assert upper - step < voltage.max() <= upper + 1e-12
    np.testing.assert_allclose(voltage, step * np.round(voltage / step), atol=1e-12)


def test_the_limit_refuses_a_sensor_with_dynamics():
    loop = case_of(LINEAR, OTHER).loop
    noise = np.random.default_rng(0).standard_normal((1, 2, 800))
    reference = 3.0 + np.sin(0.05 * np.arange(800))[None]
    with pytest.raises(ValueError, match="sensor without bandwidth, delay and"):
        performance_limit(loop, ("SIN",), reference, noise, start=200, segment=0.01)


@pytest.mark.parametrize(
    ("table", "entries", "message"),
    [
        (
            "actuator",
            {"resolution": 0.01, "bits": 16},
            "actuator: resolution and bits are both given; give one",
        ),
        (
            "sensor",
            {"bits": 16},
            "sensor: bits is given without range, the travel that it divides",
        ),
        ("sensor", {"range": 10.0}, "sensor: range is given without bits"),
        ("actuator", {"order": 2}, "actuator: order is given without bandwidth"),
        (
            "sensor",
            {"anti_aliasing_order": 2},
            "sensor: anti_aliasing_order is given without anti_aliasing",
        ),
        (
            "actuator",
            {"current_limit": 0.1},
            "actuator: current_limit is given without capacitance",
        ),
        ("sensor", {"bandwidth": 0.0}, r"sensor.bandwidth is 0.0: .* greater than"),
        (
            "sensor",
            {"bandwidth": 1e3, "order": 5},
            "sensor.order is 5: .* less than or equal to 4",
        ),
        ("actuator", {"bits": 64}, "actuator.bits is 64: .* less than or equal to 32"),
        ("actuator", {"bits": 12.5}, "actuator.bits is 12.5: .* valid integer"),
        ("sensor", {"delay": -1e-3}, "sensor.delay is -0.001: .* greater than"),
        ("actuator", {"computation": -1.0}, "actuator.computation is -1.0"),
        ("actuator", {"bandwith": 1e3}, "did you mean 'bandwidth'"),
        (
            "actuator",
            {"bits": 1, "range": 100.0},
            "the converter has steps of 50 V, less than two of them from -4 to 20 V",
        ),
        (
            "actuator",
            {"computation": 60.0, "delay": 3e-4},
            "actuator: the delay is 66 samples of 5e-05 s; it must be at most 64",
        ),
        (
            "sensor",
            {"bandwidth": [1e3, 2e3]},
            "sensor.bandwidth holds 2 values; the study has 1 axis",
        ),
    ],
)
def test_bad_hardware_is_refused(table, entries, message):
    with pytest.raises(ValueError, match=message) as caught:
        build(validated(Study, tables({table: entries}), ""), "small.toml")
    assert "\n" not in str(caught.value)
