"""Resonances behind slow sensors are found, and fits start from them."""

import numpy as np
import pytest
import scipy.signal
from oracles import excitation, forty_stages
from oracles import resonant_records as records

from piezojax import Record, identify
from piezojax.identification.chain import dynamics_of, dynamics_parts
from piezojax.identification.estimators.refined import refined_instrumental_variables
from piezojax.identification.estimators.resonances import (
    LinearDynamics,
    linear_dynamics,
    samples_early,
)
from piezojax.identification.plausibility import early_warnings

DT = 1.0 / records.RATE
FREQUENCY, DAMPING = 0.01, 0.2
"""Largest relative errors."""


def record(case):
    return Record(*records.measured(case), DT, source=f"made up, {case.excitation}")


def check(resonance, case):
    assert resonance.frequency == pytest.approx(case.frequency, rel=FREQUENCY)
    assert resonance.damping == pytest.approx(case.damping, rel=DAMPING)


CASES = [case._replace(seconds=1.0) for case in records.grid()[1::6]]
# At 0.4 of the sampling rate, a lag that is not found leaves the mode a third of its
# gain.
CASES.append(records.grid()[56])


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c.excitation}-{c.seed}")
def test_a_resonance_is_found(case):
    found = dynamics_of(record(case))
    assert len(found.modes) == 1
    check(found.modes[0], case)


@pytest.mark.parametrize("excitation", records.EXCITATIONS)
def test_a_stage_without_a_resonance_has_none(excitation):
    case = records.Case(excitation, frequency=None, seconds=1.0, noise=0.005)
    assert dynamics_parts(record(case)) == "lag"
    assert dynamics_of(record(case)).modes == ()


@pytest.mark.slow
def test_the_named_stage_is_fitted_by_default():
    case = records.NAMED._replace(seconds=0.4)
    fit = identify(record(case))
    assert fit.report.model.endswith("+exponential_creep+modes")
    assert fit.report.found.startswith("a resonance at 7")
    found = fit.report.parameters
    for name, truth, most in (
        ("frequency", case.frequency, FREQUENCY),
        ("damping", case.damping, DAMPING),
        ("time_constant", case.lag, 0.3),
    ):
        parameter = found[f"dynamics.{name}.0"]
        assert parameter.value == pytest.approx(truth, rel=most)
        assert parameter.standard_error > 0.0


def test_a_delay_is_distinguished_from_a_resonance():
    input, output = records.measured(records.Case("PRBS", lag=0.0, seconds=1.0))
    found = linear_dynamics(input, np.r_[np.full(3, output[0]), output[:-3]], DT)
    check(found.modes[0], records.NAMED)
    assert found.delay == pytest.approx(3 * DT, abs=0.2 * DT)


def moved_ahead(output, samples):
    return np.r_[output[samples:], np.full(samples, output[-1])]


@pytest.mark.parametrize("case", CASES[::3], ids=lambda c: f"{c.excitation}-{c.seed}")
def test_no_output_is_early(case):
    assert samples_early(*records.measured(case), DT) == 0.0


@pytest.mark.parametrize("lag", [0.0, 3e-4])
@pytest.mark.parametrize("kind", records.EXCITATIONS)
def test_an_output_saved_early_is_noticed(kind, lag):
    case = records.Case(kind, lag=lag, seconds=0.5)
    input, output = records.measured(case)
    found = samples_early(input, moved_ahead(output, 2), DT)
    assert found == pytest.approx(2.0, abs=0.3)


def test_without_a_resonance_no_output_is_early():
    input, output = records.measured(records.Case("PRBS", frequency=None, seconds=1.0))
    assert samples_early(input, moved_ahead(output, 2), DT) == 0.0
    assert samples_early(input[:100], output[:100], DT) == 0.0


@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize(("number", "early"), [(14, 0.5), (12, 2.0)])
def test_an_early_output_of_another_class_has_an_alarm(number, early):
    """The stages have 1.5 samples of delay and none; their outputs are 2 ahead."""
    stage = forty_stages.stage(number)
    input, output = excitation.record(stage)
    train = slice(0, len(input) // 2)
    assert early_warnings(Record(input, output, stage.dt), train) == []
    shifted = Record(input, moved_ahead(output, 2), stage.dt)
    (alarm,) = early_warnings(shifted, train)
    assert "sooner than a loop can read it" in alarm
    assert float(alarm.split()[5]) == pytest.approx(early, abs=0.2)
    loop = Record(shifted.input, shifted.output, stage.dt, reference=shifted.output)
    assert early_warnings(loop, train) == []


def test_the_slope_is_that_of_the_hysteresis_and_not_of_the_overshoot():
    input, output = records.measured(records.Case("steps", lag=0.0, seconds=1.0))
    found = linear_dynamics(input, -output, DT)
    assert found.slope == pytest.approx(-records.SLOPE, rel=0.4)


@pytest.mark.parametrize("samples", [100, 5000])
def test_a_single_sine_gives_no_resonance(samples):
    time = DT * np.arange(samples)
    input = 50.0 - 40.0 * np.cos(2 * np.pi * 50.0 * time)
    assert linear_dynamics(input, records.plays(input), DT).modes == ()


def test_a_short_record_gives_no_resonance():
    input = np.random.default_rng(0).standard_normal(100)
    assert linear_dynamics(input, input, DT) == LinearDynamics()


# The transfer function


A = np.real(np.poly([0.9 * np.exp(0.8j), 0.9 * np.exp(-0.8j), 0.7]))
B = np.array([0.3, 0.1, -0.05])
DRIVE = np.random.default_rng(1).standard_normal(4000)


def test_a_transfer_function_is_exact_without_noise():
    output = scipy.signal.lfilter(np.r_[0.0, 0.0, B], A, DRIVE)
    found = refined_instrumental_variables(DRIVE, output, 3, 2, delay=2)
    np.testing.assert_allclose(found.denominator, A, atol=1e-8)
    np.testing.assert_allclose(found.numerator, B, atol=1e-8)
    np.testing.assert_allclose(found.applied(DRIVE), output, atol=1e-7)


def test_white_and_coloured_noise_leave_it_unbiased():
    clean = scipy.signal.lfilter(np.r_[0.0, B], A, DRIVE)
    white = np.random.default_rng(2).standard_normal((2, 4000))
    slow = scipy.signal.lfilter([1.0], [1.0, -0.95], white[1])
    output = clean + 0.2 * white[0] + 0.05 * slow
    found = refined_instrumental_variables(DRIVE, output, 3, 2)
    np.testing.assert_allclose(found.denominator, A, atol=0.02)
    # The initial least-squares estimate has a large error.
    rows = np.stack([-output[2:-1], -output[1:-2], -output[:-3]], axis=1)
    rows = np.column_stack([rows, DRIVE[2:-1], DRIVE[1:-2], DRIVE[:-3]])
    biased = np.linalg.lstsq(rows, output[3:], rcond=None)[0][:3]
    assert np.max(np.abs(biased - A[1:])) > 0.1
    errors = found.whitened(output - found.applied(DRIVE))
    near = [errors[k:] @ errors[: errors.size - k] for k in (1, 2, 5)]
    assert np.max(np.abs(near)) < 0.06 * (errors @ errors)


def test_an_input_that_excites_nothing_is_refused():
    with pytest.raises(ValueError, match="do not determine the coefficients"):
        refined_instrumental_variables(np.zeros(400), DRIVE[:400], 2, 2)
