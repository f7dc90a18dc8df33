"""Free-run fits against known parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import Record, identify
from piezojax.catalog import p753
from piezojax.core.paths import replace
from piezojax.core.system import series
from piezojax.dynamics import FirstOrderLag
from piezojax.hysteresis import PrandtlIshlinskii, Preisach, RateDependentPreisach
from piezojax.identification import free_run
from piezojax.identification.chain import structure
from piezojax.identification.estimators import output_error, standard_errors
from piezojax.identification.estimators.approach import TURNS, run_after
from piezojax.identification.estimators.error_problem import at_starts, problem_of
from piezojax.identification.estimators.free_runs import starts_of
from piezojax.identification.estimators.linear_start import Start, start_columns

MODEL = "coleman_hodgdon+arma"


def p753_record(samples, seed):
    """Return a record of large slow motions, tones up to 2.9 kHz and 12 nm noise."""
    time = np.arange(samples) * p753.DT
    u = 45.0 + 25.0 * np.linspace(1.0, 0.3, samples) * np.sin(2 * np.pi * 7.0 * time)
    for hertz, volts in ((43, 15), (310, 6), (700, 4), (1500, 4), (2900, 4)):
        u += volts * np.sin(2 * np.pi * hertz * time + hertz)
    clean = np.asarray(free_run(p753.plant(), jnp.asarray(u), 0.0))
    noise = np.random.default_rng(seed).standard_normal(samples)
    return Record(u, clean + p753.NOISE_RMS * noise, p753.DT, source="P-753")


@pytest.mark.slow
def test_noise_does_not_bias_the_fit_of_the_p753():
    record = p753_record(20_000, 1)
    fit = identify(record, MODEL, train=slice(0, 18_000))
    truth = p753.plant()
    np.testing.assert_allclose(
        np.sort(fit.system.parts[1].poles()),
        np.sort(truth.parts[1].poles()),
        rtol=0.01,
    )
    found = fit.report.parameters["hysteresis.c"]
    assert found.value == pytest.approx(float(truth.parts[0].c), rel=0.02)
    assert abs(found.value - float(truth.parts[0].c)) < 4.0 * found.standard_error
    assert fit.report.validation.rmse == pytest.approx(p753.NOISE_RMS, rel=0.03)


def several_records():
    """Return the fit of a short and a long record, its point, and the records."""
    records = [p753_record(100, 1), p753_record(160, 2)]
    whole = structure(MODEL, records[1])
    shape = whole.without(whole.own)
    part = slice(20, 160)
    problem = problem_of(shape, records, part)
    unit = jnp.full(len(shape.space.paths), 0.4)
    found, *_ = starts_of(shape.space.put(shape.system, unit), records, part)
    return at_starts(problem, found), unit, records


def test_residuals_of_records_of_different_length_exclude_the_padding():
    problem, unit, records = several_records()
    system = problem.space.put(problem.system, unit)
    squares = 0.0
    for row, record in enumerate(records):
        u = jnp.asarray(record.input)
        start = jax.tree.map(lambda leaf, row=row: leaf[row], problem.starts)
        columns = np.asarray(start_columns(system, u, start))[:, 20:, 0].T
        error = (record.output - np.asarray(run_after(system, u, start.levels)))[20:]
        # The zero has no penalty; the states have that of their prior.
        count = columns.shape[1] - 1
        cost = np.eye(count, 1 + count, 1) * np.sqrt(start.variance)
        rows = np.concatenate([columns, cost])
        values = np.concatenate([error, np.zeros(count)])
        amounts = np.linalg.lstsq(rows, values)[0]
        squares += np.sum((values - rows @ amounts) ** 2)
    expected = squares / (80 + 140)
    residuals = jax.jit(lambda u: problem.residuals(u))(unit)
    np.testing.assert_allclose(jnp.sum(residuals**2), expected, rtol=1e-7)


@pytest.mark.parametrize(
    "hysteresis",
    [
        Preisach(np.eye(6), 0.0, 100.0),
        RateDependentPreisach(Preisach(np.eye(6), 0.0, 100.0), np.eye(6), 10.0, 1e-3),
        PrandtlIshlinskii((0.1,), (5.0, 10.0, 20.0, 30.0), (0.01,) * 4),
    ],
)
def test_only_linear_states_are_corrected_before_a_record(hysteresis):
    # The path before the record gives the memory of a hysteresis.
    system = series(hysteresis=hysteresis, lag=FirstOrderLag(2e-3, 1e-3))
    u = 50.0 + 15.0 * jnp.sin(0.1 * jnp.arange(100.0))
    start = Start(jnp.full(TURNS, 50.0), jnp.array([35.0, 65.0]), jnp.asarray(1.0))
    zero, *states = np.asarray(start_columns(system, u, start))[..., 0]
    np.testing.assert_allclose(zero, 1.0)
    assert len(states) == 1


def test_the_gradient_of_the_squares_is_right_at_the_most_likely_starts():
    # The Jacobian contains the responses to the starts; the gradient must not.
    problem, unit, _ = several_records()

    def squares(u):
        return jnp.sum(problem.residuals(u) ** 2)

    steps = 1e-6 * jnp.eye(unit.size)
    slope = jax.jit(jax.jacfwd(squares))(unit)
    ends = jax.jit(jax.vmap(squares))(jnp.concatenate([unit + steps, unit - steps]))
    differences = (ends[: unit.size] - ends[unit.size :]) / 2e-6
    np.testing.assert_allclose(slope, differences, rtol=1e-3, atol=1e-6)


def test_an_undetermined_parameter_has_no_standard_error():
    # Without motion below 30 V the rest point is undetermined.
    time = np.arange(600) * p753.DT
    u = 50.0 + 15.0 * np.sin(2 * np.pi * 100.0 * time)
    u[:2] = 30.0, 40.0
    y = np.asarray(free_run(p753.plant(), jnp.asarray(u), 0.0))
    y = y + 1e-3 * np.random.default_rng(0).standard_normal(600)
    fit = identify(Record(u, y, p753.DT, source="one tone"), MODEL)
    text = " ".join(fit.report.warnings)
    assert "not exciting enough" in text or "one frequency" in text


def test_the_first_samples_show_the_range_of_the_input(monkeypatch):
    monkeypatch.setattr(output_error, "LEADING", 10)
    late = np.concatenate([np.zeros(25), np.linspace(0.0, 1.0, 75)])
    assert output_error.leading(np.sin(np.arange(100)), slice(0, 100)) == slice(0, 10)
    assert output_error.leading(np.sin(np.arange(100)), slice(5, 100)) == slice(5, 15)
    assert output_error.leading(late, slice(0, 100)) == slice(0, 100)
    assert output_error.leading(np.minimum(late, 0.15), slice(0, 100)) == slice(0, 40)
    assert output_error.leading(np.sin(np.arange(19)), slice(0, 19)) == slice(0, 19)


@pytest.mark.slow
@pytest.mark.parametrize("leading", [output_error.LEADING, 700])
def test_hysteresis_creep_lag_and_delay_are_recovered(leading, monkeypatch):
    monkeypatch.setattr(output_error, "LEADING", leading)
    # Three frequencies, a decade apart: the phase of a lag and a delay depends on
    # frequency, that of hysteresis does not, and creep decreases with frequency.
    model, dt = "coleman_hodgdon+logarithmic_creep+lag+delay", 2e-3
    time = np.arange(3000) * dt
    level = np.select([time < 2.5, time < 4.5], [1.0, 0.7], 0.5)
    tone = [np.sin(2 * np.pi * f * time) for f in (0.8, 8.0, 40.0)]
    u = 40.0 + level * (25.0 * tone[0] + 12.0 * tone[1] + 5.0 * tone[2])
    shape = structure(model, Record(u, 0.12 * u, dt))
    truth = {
        "hysteresis.a": 0.0077,
        "hysteresis.b": 0.1167,
        "hysteresis.c": -0.0487,
        "hysteresis.rest_input": 30.0,
        "hysteresis.rest_output": 0.0,
        "creep.gain_per_decade": 0.02,
        "lag.time_constant": 4e-3,
        "delay.delay": 3.3e-3,
        "calibration.offset": 2.0,
    }
    clean = free_run(replace(shape.system, truth), jnp.asarray(u), 30.0)
    noise = 3e-3 * np.random.default_rng(3).standard_normal(u.size)
    fit = identify(Record(u, np.asarray(clean) + noise, dt, source="made"), model)
    assert fit.report.validation.rmse == pytest.approx(3e-3, rel=0.1)
    for path, accuracy in {
        "hysteresis.c": 0.05,
        "creep.gain_per_decade": 0.05,
        "lag.time_constant": 0.03,
        "delay.delay": 0.03,
    }.items():
        found = fit.report.parameters[path]
        assert found.value == pytest.approx(truth[path], rel=accuracy), path
        assert abs(found.value - truth[path]) < 4.0 * found.standard_error, path


def test_all_passes_of_a_fit_are_one_program(monkeypatch):
    record = p753_record(200, 1)
    shape = structure(MODEL, record)
    shape = shape._replace(starts=shape.starts[:2], whitening=(1.0, -0.5))
    program, shapes = output_error.equations_at, set()

    def counted(problem, free):
        shapes.add(free.shape)
        return program(problem, free)

    for module in (output_error, standard_errors):
        monkeypatch.setattr(module, "equations_at", counted)
    found = output_error.output_error(shape, [record], slice(0, 200), steps=2)
    standard_errors.values_and_errors(found)
    assert len(shapes) == 1
