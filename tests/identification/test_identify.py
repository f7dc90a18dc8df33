"""Fits of a known plant, and of the record that comes with piezojax."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Record,
    identify,
    load,
    read_record,
    save,
    series,
)
from piezojax.core.registry import parts
from piezojax.core.system import Affine
from piezojax.dynamics import (
    FirstOrderLag,
)
from piezojax.hysteresis import (
    ColemanHodgdon,
)
from piezojax.identification import Options, free_run
from piezojax.study import shipped

DT = 1e-3
SAMPLES = 1200
MODEL = "coleman_hodgdon"
TRAIN = slice(0, 900)
NOISE = 0.01
TRUTH = {
    "hysteresis.a": 0.0077,
    "hysteresis.b": 0.1167,
    "hysteresis.c": -0.0487,
    "lag.time_constant": 2.5e-3,
    "calibration.offset": -3.0,
}
REST = 2.0  # V before the record, which begins with a step to 10 V
DRAWS = 6


def excitation():
    """Return voltages of six amplitudes and two frequencies, from 10 V upwards."""
    time = np.arange(SAMPLES) * DT
    span = np.array([60.0, 40.0, 20.0, 50.0, 30.0, 10.0])[(time / 0.2).astype(int)]
    frequency = np.where(time < 0.6, 10.0, 25.0)
    return 10.0 + 0.5 * span * (1.0 - np.cos(2.0 * np.pi * frequency * time))


INPUT = excitation()


@pytest.fixture(scope="module")
def clean():
    system = series(
        hysteresis=ColemanHodgdon(
            a=TRUTH["hysteresis.a"],
            b=TRUTH["hysteresis.b"],
            c=TRUTH["hysteresis.c"],
            rest_input=REST,
        ),
        lag=FirstOrderLag(TRUTH["lag.time_constant"], DT),
        calibration=Affine(1.0, TRUTH["calibration.offset"]),
    )
    return np.asarray(free_run(system, jnp.asarray(INPUT), REST))


def noisy(clean, seed):
    return clean + NOISE * np.random.default_rng(seed).standard_normal(SAMPLES)


def record_of(input, output):
    return Record(input, output, DT, source="made up")


@pytest.fixture(scope="module")
def fits(clean):
    return [
        identify(record_of(INPUT, noisy(clean, seed)), MODEL, train=TRAIN)
        for seed in range(DRAWS)
    ]


def values(fits, path):
    found = [fit.report.parameters[path] for fit in fits]
    return np.array([[p.value, p.standard_error] for p in found]).T


@pytest.mark.parametrize("path", TRUTH)
def test_a_known_plant_is_found(fits, path):
    value, error = values(fits, path)
    assert np.all(np.abs(value - TRUTH[path]) < 3.0 * error)
    np.testing.assert_allclose(value, TRUTH[path], rtol=0.02)


@pytest.mark.parametrize("path", TRUTH)
def test_standard_errors_equal_the_scatter_over_noise_draws(fits, path):
    value, error = values(fits, path)
    assert 0.5 < np.std(value, ddof=1) / np.mean(error) < 2.0


def test_the_residual_is_the_noise(fits):
    for fit in fits:
        for part in (fit.report.train, fit.report.validation):
            assert part.rmse == pytest.approx(NOISE, rel=0.1)
            assert part.unit == "um"
            assert part.rmse_percent_of_span == pytest.approx(
                100.0 * part.rmse / fit.record.span
            )


def test_the_errors_are_those_of_the_returned_simulation(fits):
    fit = fits[0]
    error = fit.simulated - fit.record.output
    rms = [np.sqrt(np.mean(error[part] ** 2)) for part in (TRAIN, slice(900, SAMPLES))]
    assert fit.report.train.rmse == pytest.approx(rms[0], rel=1e-12)
    assert fit.report.validation.rmse == pytest.approx(rms[1], rel=1e-12)
    assert (fit.train, fit.validate) == (TRAIN, slice(900, SAMPLES))


def test_a_rich_record_gives_no_warning(fits):
    # The only warnings are the undetermined rest point and the narrow band.
    for fit in fits:
        for text in fit.report.warnings:
            assert "rest_" in text or "excites nothing above" in text


def test_the_simulation_uses_the_input_alone(fits):
    fit = fits[0]
    before = fit.report.parameters["input before the record"].value
    again = free_run(fit.system, jnp.asarray(INPUT), before)
    np.testing.assert_allclose(fit.simulated, again, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["model.json", "model.toml"])
def test_a_saved_model_gives_the_same_simulation(fits, tmp_path, name):
    fit = fits[0]
    save(fit.system, tmp_path / name)
    back = load(tmp_path / name)
    again = free_run(back, jnp.asarray(INPUT), back.parts[0].rest_input)
    expected = free_run(fit.system, jnp.asarray(INPUT), fit.system.parts[0].rest_input)
    np.testing.assert_array_equal(again, expected)


def test_the_report_has_the_agreed_keys(fits):
    report = json.loads(fits[0].report.model_dump_json())
    assert {"model", "parameters", "train", "validation", "warnings"} <= set(report)
    assert "wall_s" in report
    assert report["model"] == "coleman_hodgdon"
    for part in ("train", "validation"):
        assert set(report[part]) >= {"rmse", "rmse_percent_of_span", "unit"}
    assert set(TRUTH) <= set(report["parameters"])
    for parameter in report["parameters"].values():
        assert set(parameter) == {"value", "standard_error"}


def test_samples_outside_training_do_not_change_the_fit(clean, fits):
    output = noisy(clean, 0)
    output[TRAIN.stop :] += 50.0
    fit = identify(record_of(INPUT, output), MODEL, train=TRAIN)
    assert fit.report.parameters == fits[0].report.parameters
    assert fit.report.train.rmse == fits[0].report.train.rmse
    assert fit.report.validation.rmse == pytest.approx(50.0, rel=1e-3)


def test_other_units_change_the_units_only(clean, fits):
    fit = identify(record_of(1e3 * INPUT, 1e-3 * noisy(clean, 0)), MODEL, train=TRAIN)
    for path, factor in {
        "hysteresis.a": 1e-9,
        "hysteresis.b": 1e-6,
        "hysteresis.c": 1e-3,
        "lag.time_constant": 1.0,
        "calibration.offset": 1e-3,
    }.items():
        expected = fits[0].report.parameters[path]
        found = fit.report.parameters[path]
        assert found.value == pytest.approx(expected.value * factor, rel=1e-5)
        assert found.standard_error == pytest.approx(
            expected.standard_error * abs(factor), rel=1e-3
        )


def test_a_training_part_without_motion_is_refused(clean):
    early = np.arange(SAMPLES) < TRAIN.stop
    record = record_of(np.where(early, 5.0, INPUT), noisy(clean, 1))
    message = "made up, first 900 samples: input never changes"
    with pytest.raises(ValueError, match=message):
        identify(record, MODEL, train=TRAIN)


# The record that comes with piezojax


@pytest.fixture(scope="module")
def shipped_fit():
    record = read_record(
        shipped().parent / "data" / "micromanipulator.csv",
        time="time_s",
        input="input_V",
        output="displacement_um",
    )
    return identify(record, MODEL)


@pytest.mark.slow
def test_the_error_on_the_shipped_record_is_below_one_percent(shipped_fit):
    report = shipped_fit.report
    assert report.validation.rmse <= 0.40
    assert report.validation.rmse_percent_of_span < 1.0
    assert report.validation.unit == "um"
    assert shipped_fit.train == slice(0, 1200)
    assert shipped_fit.validate == slice(1200, 2400)


@pytest.mark.slow
def test_the_shipped_record_warns_of_its_one_frequency(shipped_fit):
    text = " ".join(shipped_fit.report.warnings)
    assert "essentially one frequency" in text
    assert "says nothing about other frequencies" in text


@pytest.mark.slow
def test_the_lag_of_the_shipped_record(shipped_fit):
    # An independent fit found a time constant of 14 ms behind one sample of delay
    # (tuning/data/micromanipulator.md).
    lag = shipped_fit.report.parameters["lag.time_constant"].value
    assert lag == pytest.approx(0.014, abs=0.004)


@pytest.mark.parametrize("model", ["bashash_jalili", "prandtl_ishlinskii"])
def test_every_hysteresis_has_a_warning_for_one_frequency(model):
    input = 50.0 - 50.0 * np.cos(0.05 * np.arange(400))
    fit = identify(record_of(input, 0.1 * input), model, options=Options(steps=1))
    assert any("one frequency: only the shape" in w for w in fit.report.warnings)


# Refused input


@pytest.fixture
def record():
    return record_of(INPUT, 0.1 * INPUT)


@pytest.mark.parametrize(
    "name", ["krasnoselskii", "", "ColemanHodgdon", "lag+bouc_wen"]
)
def test_unknown_model(record, name):
    part = name.split("+")[-1]
    message = f"a model has no part {part!r}; there are "
    with pytest.raises(ValueError, match=re.escape(message)) as e:
        identify(record, name)
    assert all(model in str(e.value) for model in parts())


def test_two_parts_in_one_place(record):
    name = "coleman_hodgdon+prandtl_ishlinskii"
    with pytest.raises(ValueError, match="has two parts for its hysteresis"):
        identify(record, name)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"train": slice(5, 3)}, "train is 5:3; it must lie in 0:1200 and hold a"),
        ({"train": slice(7, 7)}, "train is 7:7; it must lie in 0:1200"),
        ({"train": slice(-5, 300)}, "train is -5:300; it must lie in 0:1200"),
        ({"train": slice(0, 1201)}, "train is 0:1201; it must lie in 0:1200"),
        (
            {"train": slice(0, 1200)},
            "train is 0:1200, the whole record: nothing is left",
        ),
        ({"validate": slice(900, 1300)}, "validate is 900:1300; it must lie in 0:12"),
        ({"validate": slice(900, 900)}, "validate is 900:900; it must lie in 0:1200"),
    ],
)
def test_bad_parts(record, parts, message):
    with pytest.raises(ValueError, match=message):
        identify(record, **parts)


def test_a_part_without_an_end(clean, fits):
    fit = identify(
        record_of(INPUT, noisy(clean, 0)), model=MODEL, train=slice(None, TRAIN.stop)
    )
    assert fit.report.parameters == fits[0].report.parameters


def test_the_rest_point_is_found_or_has_a_warning(fits):
    for fit in fits:
        rest = fit.report.parameters["hysteresis.rest_input"]
        deviation = rest.standard_error
        found = deviation is not None and abs(rest.value - REST) < 4.0 * deviation
        assert found or any("rest_input" in text for text in fit.report.warnings)


def test_a_stage_with_negative_gain_is_fitted(clean):
    fit = identify(record_of(INPUT, -noisy(clean, 0)), MODEL, train=TRAIN)
    assert fit.report.validation.rmse == pytest.approx(NOISE, rel=0.1)


def test_a_model_that_explains_nothing_has_a_warning():
    measured = np.random.default_rng(5).standard_normal(SAMPLES)
    fit = identify(record_of(INPUT, measured), MODEL, train=TRAIN)
    assert fit.report.validation.rmse > 0.2 * np.std(measured)
    assert any("error" in text or "fit" in text for text in fit.report.warnings)


def test_validation_on_training_samples_has_a_warning(clean):
    record = record_of(INPUT, noisy(clean, 0))
    try:
        fit = identify(record, MODEL, train=TRAIN, validate=slice(600, 900))
    except ValueError:
        return
    assert any("validat" in text for text in fit.report.warnings)


@pytest.mark.parametrize("zero", [0.0, 500.0])
def test_the_zero_of_another_sensor_is_no_motion_to_explain(clean, zero):
    """The stage moves three times as far in the validation part as in training."""
    first = clean - clean[0]
    first[900:] *= 3.0
    records = [record_of(INPUT, first), record_of(INPUT, first + zero)]
    report = identify(records, "lag", train=TRAIN, validate=slice(900, 1200)).report
    assert any("the model explains little" in alarm for alarm in report.alarms)
    assert any("2.9" in each and "times as far" in each for each in report.warnings)


def test_an_output_that_only_shows_noise_has_no_alarm():
    random = np.random.default_rng(3)
    drive = random.standard_normal(SAMPLES)
    moved = np.convolve(drive, 0.5 ** np.arange(1, 20))[: SAMPLES - 1]
    quiet = 1e-3 * random.standard_normal(SAMPLES)
    bent = np.convolve(drive**2, 0.8 ** np.arange(20))[:SAMPLES]
    for second, expected in ((quiet, False), (bent, True)):
        outputs = np.column_stack([np.r_[0.0, moved], second])
        both = Record(drive[:, None], outputs, DT)
        report = identify(both, "state_space", options=Options(order=2)).report
        found = ["explains little of output 1" in alarm for alarm in report.alarms]
        assert found == [True] * expected
