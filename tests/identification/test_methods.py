"""The methods of ``identify`` by name, on records of one and several channels."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from piezojax import (
    Record,
    identify,
    series,
)
from piezojax.core.system import Affine
from piezojax.dynamics import (
    ARMA,
    FirstOrderLag,
    StateSpace,
)
from piezojax.hysteresis import (
    ColemanHodgdon,
)
from piezojax.identification import METHODS, Options, free_run, validate

DT = 1e-3
PERIOD = 512
A, B = (1.5, -0.6), (0.08, 0.05)
OFFSET = 3.0
NOISE = 1e-3


def multisine(seed, periods=6):
    rng = np.random.default_rng(seed)
    lines = np.arange(1, PERIOD // 2)
    time = np.arange(PERIOD)
    phases = rng.uniform(0.0, 2.0 * np.pi, lines.size)
    wave = np.cos(2 * np.pi * np.outer(time, lines) / PERIOD + phases).sum(axis=1)
    return 10.0 + np.tile(wave / wave.std(), periods)


def answered(u, gain=1.0, seed=0):
    """Return the noisy output of a difference equation in which u(k) moves y(k+1)."""
    taps = [0.0, *B], [1.0, *(-a for a in A)]
    rest = signal.lfilter_zi(*taps) * u[0]
    y = signal.lfilter(*taps, u, zi=rest)[0]
    noise = np.random.default_rng(seed).standard_normal(u.size)
    return gain * y + OFFSET + NOISE * noise


def record(period=PERIOD, **changes):
    u = multisine(1)
    fields = {"inputs": u, "outputs": answered(u), "dt": DT, "source": "lab"}
    return Record(**(fields | {"period": period} | changes))


@pytest.mark.parametrize("method", ["subspace", "frequency_response"])
def test_a_linear_plant_is_identified_and_used_in_a_loop(method):
    fit = identify(
        record(),
        "state_space",
        method=method,
        options=Options(order=2, window=10),
        train=slice(0, 3 * PERIOD),
    )
    dynamics, calibration = fit.system.parts
    assert isinstance(dynamics, ARMA)
    poles = np.roots([1.0, -A[0], -A[1]])
    np.testing.assert_allclose(
        np.sort_complex(dynamics.poles()), np.sort_complex(poles), rtol=0.01
    )
    gain = sum(B) / (1.0 - sum(A))
    np.testing.assert_allclose(dynamics.dc_gain(), gain, rtol=0.01)
    np.testing.assert_allclose(calibration.offset, OFFSET, atol=0.02)
    assert fit.report.validation.rmse < 3.0 * NOISE
    u = fit.record.input
    again = free_run(fit.system, jnp.asarray(u), u[0])
    # A periodic record starts in steady state, a plant in a loop at rest.
    np.testing.assert_allclose(again[PERIOD:], fit.simulated[PERIOD:], atol=5 * NOISE)


def test_every_output_has_an_error():
    u = multisine(1)
    outputs = np.stack([answered(u), answered(u, gain=4.0, seed=1)], axis=1)
    fit = identify(record(outputs=outputs), "state_space", options=Options(order=2))
    assert isinstance(fit.system, StateSpace)
    assert fit.simulations[0].shape == outputs.shape
    each = np.sqrt(np.mean((fit.simulations[0] - outputs)[fit.validate] ** 2, axis=0))
    np.testing.assert_allclose(fit.report.validation.each, each)
    assert fit.report.validation.rmse == pytest.approx(np.sqrt(np.mean(each**2)))
    with pytest.raises(ValueError, match="the model has 2 outputs; it needs one"):
        _ = fit.simulated


def test_records_that_drive_one_channel_in_turn_are_stacked():
    u = multisine(1), multisine(2)
    gains = np.array([[1.0, 0.2], [-0.3, 2.0]])  # from input j to output i
    records = [
        Record(
            u[j],
            np.transpose([answered(u[j], gains[i, j], 2 * j + i) for i in range(2)]),
            DT,
            source=f"channel {j}",
        )
        for j in range(2)
    ]
    fit = identify(records, "state_space", options=Options(order=2))
    found = np.asarray(fit.system.dc_gain())
    np.testing.assert_allclose(found, gains * sum(B) / (1 - sum(A)), rtol=0.05)
    assert len(fit.simulations) == 2


GAINS = np.array([[1.0, 0.2], [-0.3, 2.0]])
"""From input j to output i."""


def driven(*inputs, **more):
    """Return a record of a stage with ``GAINS`` under one or several inputs."""
    outputs = [
        sum(
            answered(u, gain, 5 * i + j)
            for j, (u, gain) in enumerate(zip(inputs, row, strict=True))
        )
        for i, row in enumerate(more.pop("gains", GAINS))
    ]
    return Record(np.transpose(inputs), np.transpose(outputs), DT, **more)


@pytest.mark.parametrize("periods", [(4, 6), (6, 4)])
def test_the_inputs_keep_the_order_of_the_records(periods):
    records = [
        driven(
            (1.0 + 3.0 * j) * multisine(j, periods[j]),
            gains=GAINS[:, [j]],
            source=f"drives {j}",
        )
        for j in range(2)
    ]
    fit = identify(records, "state_space", options=Options(order=2))
    found = np.asarray(fit.system.dc_gain())
    np.testing.assert_allclose(found, GAINS * sum(B) / (1 - sum(A)), rtol=0.05)
    # Records and runs are sorted, the inputs are not.
    assert [one.samples for one in fit.records] == [6 * PERIOD, 4 * PERIOD]
    assert fit.report.train.rmse < 10.0 * NOISE
    about = fit.about
    assert about.units == dict.fromkeys(("input 0", "input 1"), "V") | dict.fromkeys(
        ("output 0", "output 1"), "um"
    )
    ranges = [(one.input.min(), one.input.max()) for one in records]
    np.testing.assert_array_equal(about.input_ranges, ranges)
    np.testing.assert_array_equal(about.input_slews, [r.slews[0] for r in records])
    both = driven(multisine(4), 4.0 * multisine(5), source="both")
    checked = validate(fit.system, about, both)
    assert checked.report.alarms == []
    assert checked.report.records[0].rmse < 20.0 * NOISE


def test_records_of_one_stage_share_all_but_zero_and_initial_state():
    time = np.arange(600) * DT
    plant = {"a": 0.0077, "b": 0.1167, "c": -0.0487}
    records, rests = [], (-10.0, 25.0)
    for number, rest in enumerate(rests):
        u = 30 + (30 - 8 * number) * np.sin(2 * np.pi * (7 + 6 * number) * time)
        system = series(
            hysteresis=ColemanHodgdon(**plant, rest_input=rest),
            lag=FirstOrderLag(2.5e-3, DT),
            calibration=Affine(1.0, -3.0 + 0.5 * number),
        )
        noise = NOISE * np.random.default_rng(number).standard_normal(u.size)
        y = np.asarray(free_run(system, jnp.asarray(u), rest)) + noise
        records.append(Record(u, y, DT, source=f"run {number}"))
    fit = identify(records, "coleman_hodgdon", train=slice(0, 400))
    for name, value in plant.items():
        found = fit.report.parameters[f"hysteresis.{name}"]
        assert abs(found.value - value) < 4.0 * found.standard_error
    assert fit.report.validation.rmse == pytest.approx(NOISE, rel=0.2)
    zeros = [fit.report.parameters[f"zero of run {i}"].value for i in range(2)]
    assert zeros[1] - zeros[0] == pytest.approx(0.5, abs=0.01)
    assert fit.units["zero of run 0"] == "um"
    assert "hysteresis.rest_input" not in fit.report.parameters


def test_a_periodic_record_trains_a_black_box():
    fit = identify(
        record(),
        "neural_state_space",
        options=Options(order=2, steps=10),
        train=slice(0, 3 * PERIOD),
    )
    assert fit.simulations[0].shape == (6 * PERIOD, 1)
    assert fit.report.validation.rmse < 10 * NOISE


def test_the_default_regression_is_not_biased_by_noise():
    u = multisine(1)
    record = Record(u, answered(u), DT, source="lab")
    fit = identify(record, "hysteretic_arma")
    plain = identify(record, "hysteretic_arma", method="least_squares")
    assert (
        fit.report.parameters["autoregressive.0"]
        != (plain.report.parameters["autoregressive.0"])
    )
    assert fit.report.validation.rmse < 2.0 * NOISE


@pytest.mark.parametrize(
    ("model", "method", "message"),
    [
        (
            "state_space",
            "kalman",
            "method 'kalman' is unknown; there are output_error,",
        ),
        ("state_space", "least_squares", "cannot fit 'state_space'; subspace, freq"),
        ("coleman_hodgdon", "subspace", "cannot fit 'coleman_hodgdon'; output_error"),
    ],
)
def test_methods_that_do_not_suit_the_model_are_refused(model, method, message):
    with pytest.raises(ValueError, match=message) as error:
        identify(record(), model, method=method)
    if method not in METHODS:
        assert all(name in str(error.value) for name in METHODS)


@pytest.mark.parametrize(
    ("records", "model", "message"),
    [
        ([], "coleman_hodgdon", "no record to fit a model to"),
        ([record(), record(dt=2e-3)], "coleman_hodgdon", "they must be the same"),
        ([record(), record(output_units="m")], "coleman_hodgdon", "output units"),
        ([record(), record()], "hysteretic_arma", "2 records; this method takes one"),
        ([record(period=None)], "bouc_wen", "lab: this method needs the record's per"),
        (
            [record(period=2000)],
            "bouc_wen",
            "lab: 1536 samples to fit on hold no whole",
        ),
    ],
)
def test_records_that_do_not_suit_the_method_are_refused(records, model, message):
    with pytest.raises(ValueError, match=message):
        identify(records, model)
