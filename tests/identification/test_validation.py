"""Validation of a saved model on other records of stages simulated in NumPy."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import hysteresis

import piezojax as pj
from piezojax.core.about import About
from piezojax.core.error_bound import ErrorBound
from piezojax.dynamics import ExponentialCreep, FirstOrderLag, StateSpace
from piezojax.hysteresis import PrandtlIshlinskii
from piezojax.identification import Record, free_run, validate
from piezojax.identification.estimators.start_search import start_of
from piezojax.identification.validation import ESTIMATES, default_part

DT, NOISE = 1e-4, 2e-3
THRESHOLDS, WEIGHTS, SLOPE = (5.0, 15.0, 30.0), (0.03, 0.02, 0.02), 0.1
TAU = 1e-3
MODEL = pj.series(
    hysteresis=PrandtlIshlinskii((SLOPE,), THRESHOLDS, WEIGHTS, 0.0),
    dynamics=FirstOrderLag(TAU, DT),
)
ABOUT = About(
    record="old.csv",
    rate_Hz=1.0 / DT,
    units={"input": "V", "output": "um"},
    input_ranges=[(0.0, 100.0)],
    residual_rms=[NOISE],
)


def excitation(samples=6000, low=10.0, high=90.0, seed=1):
    """Return voltages: steps of random height and length, smoothed, with noise."""
    random = np.random.default_rng(seed)
    steps = np.repeat(random.uniform(low, high, samples // 100 + 1), 100)[:samples]
    smooth = np.convolve(np.pad(steps, (60, 60), "edge"), np.hanning(121), "same")
    return smooth[60:-60] / np.hanning(121).sum() + random.normal(0.0, 0.5, samples)


def moved(u, before=(0.0,), gain=1.0, mode=None, seed=5):
    """Return the readings of the stage under ``u``, at rest at ``before`` first.

    The stage has plays and a lag; a ``mode`` (Hz) with 2 % damping follows.
    """
    way = np.concatenate(
        [np.linspace(a, b, 3000) for a, b in zip(before, (*before[1:], u[0]), strict=1)]
    )
    x = np.concatenate([way, np.full(3000, u[0]), u])
    y = SLOPE * x
    for threshold, weight in zip(THRESHOLDS, WEIGHTS, strict=True):
        y = y + weight * hysteresis.play(x, threshold, 0.0)
    pole, z, sensed = np.exp(-DT / TAU), y[0], []
    for value in y:
        sensed.append(z)
        z = pole * z + (1.0 - pole) * value
    found = np.array(sensed)
    if mode is not None:
        found = _through_mode(found, mode)
    noise = np.random.default_rng(seed).normal(0.0, NOISE, u.size)
    return gain * found[-u.size :] + noise


def _through_mode(x, frequency, damping=0.02):
    turn = -damping + 1j * np.sqrt(1.0 - damping**2)
    pole = np.exp(2.0 * np.pi * frequency * DT * turn)
    a1, a2 = -2.0 * pole.real, abs(pole) ** 2
    y = np.full(x.size, x[0])
    for k in range(2, x.size):
        y[k] = -a1 * y[k - 1] - a2 * y[k - 2] + (1.0 + a1 + a2) * x[k - 1]
    return y


def record(y, u, **changes):
    return Record(u, y, DT, source="today.csv", **changes)


@pytest.mark.parametrize("before", [(0.0,), (0.0, 100.0), (0.0, 100.0, 0.0)])
def test_the_residual_of_the_right_model_is_noise(before):
    u = excitation()
    found = validate(MODEL, ABOUT, record(moved(u, before) + 0.7, u))
    (check,) = found.report.records
    assert found.report.alarms == []
    assert check.zero == pytest.approx([0.7], abs=2e-2)
    assert NOISE < check.rmse < 1.6 * NOISE
    assert check.times_fit == pytest.approx(check.rmse / NOISE)
    assert check.estimated == (0, 1527)
    assert check.judged == (1527, 6000)


def test_estimating_the_state_before_the_record_reduces_the_error():
    # Motions within an inner loop do not erase the path before them.
    u = excitation(low=40.0, high=60.0)
    y = moved(u, (0.0, 100.0))
    found = validate(MODEL, ABOUT, record(y, u))
    (check,) = found.report.records
    assert check.rmse < 1.6 * NOISE
    from_rest = np.asarray(free_run(MODEL, jnp.asarray(u), 0.0))
    assert np.std((from_rest - y)[1200:]) > 4.0 * NOISE


@pytest.mark.parametrize(
    ("low", "high", "determined"), [(35.0, 65.0, False), (10.0, 90.0, True)]
)
def test_three_turns_beyond_the_range_of_the_record_are_found(low, high, determined):
    # Pairs of levels within the ranges leave more than twice the noise. In the narrow
    # record the largest play never moves: it is a constant, as the zero is.
    u = excitation(3000, low, high)
    y = moved(u, (0.0, 112.0, 33.0, 58.0))
    ends = np.array([20.0, 100.0])
    start, run, zero = start_of(MODEL, u, y, slice(0, 3000), ends)
    assert np.std(run[:, 0] - y) < 1.1 * NOISE
    assert start.levels[1:] == pytest.approx([33.0, 58.0], abs=0.3)
    if determined:
        assert zero == pytest.approx([0.0], abs=NOISE)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_slow_errors_of_a_model_are_not_taken_for_creep(seed):
    # Plays that are 10 % too small leave slow errors. The stage does not creep, but the
    # creep of the model, 1 % for each time, could explain them in the first part.
    plays = PrandtlIshlinskii(
        (SLOPE,), THRESHOLDS, tuple(0.9 * weight for weight in WEIGHTS), 0.0
    )
    creep = ExponentialCreep((0.01,) * 3, (0.02, 0.2, 2.0), DT)
    model = pj.series(hysteresis=plays, creep=creep, dynamics=FirstOrderLag(TAU, DT))
    u = excitation(seed=seed)
    y, part, ends = moved(u) + 0.7, slice(0, 1200), np.array([10.0, 90.0])
    plain, cautious = (
        start_of(model, u, y, part, ends, estimates)[1][1200:, 0] - y[1200:]
        for estimates in (0, ESTIMATES)
    )
    assert np.sqrt(np.mean(cautious**2)) < 0.8 * np.sqrt(np.mean(plain**2))


def test_the_state_is_estimated_until_after_the_input_has_covered_its_range():
    time = DT * np.arange(4000)
    u = 50.0 + np.where(time < 0.1, 5.0, 40.0) * np.sin(2.0 * np.pi * 20.0 * time)
    part = default_part(Record(u, u, DT))
    assert part.start == 0
    # Three quarters of the period after 0.1 s, a little less for 90 % of the range,
    # and a tenth of the record.
    assert 0.165 < part.stop * DT < 0.1775
    both = np.stack([u, np.where(time < 0.14, 0.0, 1.0)], axis=1)
    assert default_part(Record(both, u, DT)).stop == 1800
    late = np.where(time < 0.3, 0.0, u)
    assert default_part(Record(late, u, DT)) == slice(0, 2000)
    steady = np.where(time < 0.01, 40.0, 60.0)
    assert default_part(Record(steady, u, DT)) == slice(0, 800)


def test_the_simulation_is_shifted_by_the_zero():
    u = excitation(2000)
    y = moved(u)
    found = validate(MODEL, ABOUT, record(y, u))
    other = validate(MODEL, ABOUT, record(y + 3.0, u))
    np.testing.assert_allclose(other.runs[0], found.runs[0] + 3.0, atol=1e-12)


def test_errors_exclude_the_estimation_part():
    u = excitation()
    y = moved(u)
    spoiled = y.copy()
    spoiled[5000:] += 0.5
    part = slice(0, 3000)
    found = validate(MODEL, ABOUT, record(spoiled, u), estimate=part)
    (check,) = found.report.records
    error = found.runs[0][3000:, 0] - spoiled[3000:]
    assert check.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
    assert check.largest == pytest.approx(np.abs(error).max(), rel=1e-12)
    assert check.percent_of_span == pytest.approx(
        100.0 * check.rmse / np.ptp(spoiled), rel=1e-12
    )
    assert check.judged == (3000, 6000)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gain": 0.5}, r"moves 0\.5\d* times as far as the model"),
        ({"gain": -1.0}, r"moves -1\d*\.?\d* times as far as the model"),
        (
            {"mode": 600.0},
            r"peak at (5[89]|6[01])\d\.?\d* Hz.*a resonance is missing or wrong",
        ),
    ],
)
def test_another_stage_raises_an_alarm(change, message):
    u = excitation()
    found = validate(MODEL, ABOUT, record(moved(u, **change), u))
    alarms = "\n".join(found.report.alarms)
    assert re.search(message, alarms), alarms
    assert all(alarm.startswith("today.csv: ") for alarm in found.report.alarms)
    assert found.about.unsafe == found.report.alarms
    assert ABOUT.unsafe == []


def test_a_model_of_another_stage_is_named():
    u = excitation()
    found = validate(MODEL, ABOUT, record(moved(u, gain=0.5), u))
    assert any(
        "it is a model of another stage (old.csv)" in alarm
        for alarm in found.report.alarms
    )


def test_small_motions_with_the_error_of_the_fit_raise_no_alarm():
    u = excitation(low=50.0, high=50.2)
    about = ABOUT.model_copy(update={"residual_rms": [0.05]})
    y = moved(u) + 0.03 * np.sin(2.0 * np.pi * 3.0 * DT * np.arange(u.size))
    found = validate(MODEL, about, record(y, u))
    assert not any("does not hold" in alarm for alarm in found.report.alarms)
    unknown = validate(MODEL, About(), record(y, u))
    assert any("does not hold" in alarm for alarm in unknown.report.alarms)


def test_a_diverging_model_raises_an_alarm():
    u = excitation(2000)
    unstable = StateSpace([[3.0]], [[1.0]], [[1.0]], [[0.0]], DT)
    found = validate(unstable, About(), record(moved(u), u))
    (check,) = found.report.records
    assert check.rmse is None
    assert "the model diverges" in found.report.alarms[0]
    assert found.report.model_dump_json()


def test_errors_by_amplitude_and_rate():
    time = DT * np.arange(8000)
    large = np.where(time < 0.4, 1.0, 0.2)
    u = 50.0 + 40.0 * large * np.sin(2.0 * np.pi * 100.0 * time)
    line = pj.Affine(0.1, 0.0)
    y = 0.11 * np.concatenate([u[:1], u[:-1]])
    found = validate(line, About(), record(y, u), estimate=slice(0, 100))
    (check,) = found.report.records
    amplitude = [part for part in check.by_input if part.kind == "amplitude"]
    assert [part.low for part in amplitude] == sorted(p.low for p in amplitude)
    small, most = amplitude[0], amplitude[-1]
    assert most.high == pytest.approx(80.0, rel=1e-2)
    assert small.low == pytest.approx(16.0, rel=1e-2)
    assert most.rmse == pytest.approx(0.01 * 40.0 / np.sqrt(2.0), rel=0.05)
    rate = [part for part in check.by_input if part.kind == "rate"]
    assert rate[-1].unit == "V/s"
    assert rate[-1].high == pytest.approx(
        40.0 * 2.0 * np.pi * 100.0 / np.sqrt(2.0), rel=0.02
    )


def test_the_bound_contains_the_error_on_both_records():
    u = excitation()
    lines = np.linspace(50.0, 5000.0, 100)
    old = ErrorBound(
        frequency=tuple(lines), relative=(0.01,) * 100, excited=(True,) * 100
    )
    about = ABOUT.model_copy(update={"error_bound": old, "checked": ["first.csv"]})
    found = validate(MODEL, about, record(moved(u, gain=0.9), u))
    bound = found.about.error_bound
    assert bound.at(100.0) == pytest.approx(0.1, rel=0.5)
    assert np.all(bound.at(lines[lines < 4900.0]) >= 0.01)
    assert found.about.checked == ["first.csv", "today.csv"]


def test_a_record_beyond_that_of_the_model_is_noted():
    u = excitation(low=-40.0, high=90.0)
    found = validate(MODEL, ABOUT, record(moved(u), u))
    (note,) = [note for note in found.report.notes if "extrapolates" in note]
    assert "the record of the model 0 to 100" in note


def test_a_larger_error_than_that_of_the_fit_is_noted():
    u = excitation()
    found = validate(MODEL, ABOUT, record(moved(u, gain=0.97), u))
    assert found.report.alarms == []
    assert any("times that on the record of the model" in n for n in found.report.notes)


def test_units_are_converted_to_those_of_the_model():
    u = excitation(2000)
    y = moved(u)
    plain = validate(MODEL, ABOUT, record(y, u))
    other = record(1e3 * y, 1e3 * u, input_units="mV", output_units="nm")
    found = validate(MODEL, ABOUT, other)
    assert found.report.records[0].rmse == pytest.approx(
        plain.report.records[0].rmse, rel=1e-9
    )
    assert found.report.records[0].unit == "um"


def test_several_channels():
    random = np.random.default_rng(3)
    system = StateSpace(
        np.diag([0.9, 0.8]), np.eye(2), [[0.1, 0.02], [0.0, 0.3]], np.zeros((2, 2)), DT
    )
    u = np.cumsum(random.normal(0.0, 1.0, (3000, 2)), axis=0)
    x, y = np.array(u[0] / (1.0 - np.array([0.9, 0.8]))), []
    for value in u:
        y.append([0.1 * x[0] + 0.02 * x[1], 0.3 * x[1]])
        x = np.array([0.9, 0.8]) * x + value
    # The step of a plant returns the next sample.
    y = np.array([y[0], *y[:-1]]) + [1.0, -2.0]
    about = About(input_ranges=[(-1e3, 1e3), (0.0, 1.0)])
    two = Record(u, y, DT, input_units=("V", "mA"), source="two.csv")
    found = validate(system, about, two)
    (check,) = found.report.records
    assert check.zero == pytest.approx([1.0, -2.0], abs=1e-6)
    assert check.rmse < 1e-6
    (note,) = [note for note in found.report.notes if "extrapolates" in note]
    assert "mA, the record of the model 0 to 1:" in note


def test_an_output_in_another_unit_has_its_own_alarm():
    """One output of 1 urad beside one of 100 um: pooled, its error would be nothing."""
    u = jnp.asarray(excitation(3000)[:, None])
    system = StateSpace(
        np.diag([0.9, 0.9]), np.ones((2, 1)), np.diag([0.1, 1e-4]), np.zeros((2, 1)), DT
    )
    y = np.array(free_run(system, u, u[0]))
    rotated = y * [1.0, -0.5]
    about = About(record="old.csv", residual_rms=[1e-3, 1e-6])
    u = np.asarray(u)
    two = Record(u, rotated, DT, output_units=("um", "urad"), source="two.csv")
    (alarm,) = (
        text
        for text in validate(system, about, two).report.alarms
        if "does not hold" in text
    )
    assert re.search(r"its error of output 1 is \d+ % of the motion", alarm)
    right = Record(u, y, DT, output_units=("um", "urad"), source="two.csv")
    assert not validate(system, about, right).report.alarms


@pytest.mark.parametrize(
    ("about", "changes", "estimate", "message"),
    [
        (ABOUT, {"output_units": "counts"}, None, "in counts, and um is needed"),
        (
            ABOUT.model_copy(update={"rate_Hz": 2e4}),
            {},
            None,
            r"sampled at 10000 Hz, and the model was made for 20000 Hz.*--resample",
        ),
        (ABOUT, {}, slice(0, 2000), "estimate is 0:2000; it must lie in 0:1999"),
        (ABOUT, {}, slice(5, 5), "estimate is 5:5"),
    ],
)
def test_records_that_cannot_be_judged(about, changes, estimate, message):
    u = excitation(2000)
    with pytest.raises(ValueError, match=message):
        validate(MODEL, about, record(moved(u), u, **changes), estimate=estimate)


def test_the_rate_of_a_model_without_an_origin_is_that_of_its_parts():
    u = excitation(2000)
    other = Record(u, moved(u), 2.0 * DT, source="slow.csv")
    with pytest.raises(ValueError, match=r"at 5000 Hz, and the model was made for 100"):
        validate(MODEL, About(), other)
    # Statics hold at any rate.
    assert validate(pj.Affine(0.17), About(), other).report.records


def test_a_model_of_other_channels():
    u = excitation(500)
    two = np.stack([u, u + np.arange(500.0)], axis=1)
    with pytest.raises(ValueError, match="no record to validate"):
        validate(MODEL, ABOUT, [])
    with pytest.raises(ValueError, match=r"2 input columns; 1 are needed"):
        validate(MODEL, ABOUT, Record(two, u, DT, source="two.csv"))
    with pytest.raises(ValueError, match=r"the model has 1 outputs and two\.csv 2"):
        validate(MODEL, About(), Record(u, two, DT, source="two.csv"))
