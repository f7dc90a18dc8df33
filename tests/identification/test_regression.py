"""Estimators of chapter 3 on a simulated P-753 with known parameters."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import regression

from piezojax import Record, load, save
from piezojax.catalog import p753
from piezojax.hysteresis import HystereticARMA
from piezojax.identification import (
    Measured,
    Orders,
    RecursiveLeastSquares,
    free_run,
    instrumental_variables,
    least_squares,
    recursive_least_squares,
    rows,
)
from piezojax.identification.estimators.regression import _Problem, _search

C = p753.HYSTERESIS_CHAPTER_5["c"]
POLES = np.sort(p753.plant().parts[1].poles())
BOUNDS = (-0.1, -0.02)
DRAWS = 4


def decaying_triangles(duration=1.0):
    """Return decaying triangles from 0 to 70 V, at five frequencies in turn."""
    parts = []
    shares = {10: 0.3, 50: 0.2, 200: 0.15, 800: 0.15, 2000: 0.2}
    for frequency, share in shares.items():
        time = np.arange(round(share * duration * p753.RATE)) / p753.RATE
        shape = 1.0 - np.abs(2.0 * (frequency * time % 1.0) - 1.0)
        parts.append(70.0 * (1.0 - 0.8 * time / (share * duration)) * shape)
    return np.concatenate(parts)


def record_of(scheme="trapezoid", seed=None, duration=1.0, offset=0.0):
    """Return a record of the P-753 at 20 kHz, with 12 nm of noise if seeded."""
    voltage = decaying_triangles(duration)
    output = free_run(p753.plant(scheme), jnp.asarray(voltage), 0.0) + offset
    noise = np.zeros(voltage.size)
    if seed is not None:
        noise = np.random.default_rng(seed).standard_normal(voltage.size)
    return Record(voltage, np.asarray(output) + p753.NOISE_RMS * noise, p753.DT)


@pytest.fixture(scope="module")
def short():
    return record_of(duration=0.2, offset=-1.5)


def truth(scheme="trapezoid", offset=0.0):
    hysteresis, dynamics = p753.plant(scheme).parts
    return HystereticARMA(
        hysteresis.c,
        dynamics.autoregressive,
        [hysteresis.a * b for b in dynamics.moving],
        [hysteresis.b * b for b in dynamics.moving],
        offset,
        scheme=scheme,
    )


def numbers(model):
    return np.array([float(leaf) for leaf in jax.tree.leaves(model)])


def poles(model):
    return np.sort(np.roots([1.0, *(-float(a) for a in model.autoregressive)]))


@pytest.mark.parametrize("scheme", ["trapezoid", "quadratic", "voros"])
def test_rows_equal_the_equation(short, scheme):
    expected = regression.rows(short.input, short.output, C, scheme)
    found = rows(short, C, Orders(scheme=scheme), short.output)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-10)


def test_rows_of_another_order(short):
    found = rows(short, C, Orders(3, 1), short.output)
    assert found.shape == (short.samples, 6)
    np.testing.assert_array_equal(found[10, :3], short.output[[9, 8, 7]])
    first, second = regression.operators(short.input, C, "trapezoid")
    np.testing.assert_allclose(found[10, 3:], [first[9], second[9], 1.0], rtol=1e-12)


# Without noise every estimator is exact


@pytest.mark.parametrize("scheme", ["trapezoid", "quadratic"])
@pytest.mark.parametrize("estimator", [least_squares, instrumental_variables])
def test_without_noise_the_parameters_are_recovered(scheme, estimator):
    record = record_of(scheme, duration=0.2, offset=-1.5)
    found = estimator(record, Orders(scheme=scheme), c=BOUNDS)
    np.testing.assert_allclose(
        numbers(found.model), numbers(truth(scheme, -1.5)), rtol=1e-4
    )
    np.testing.assert_allclose(poles(found.model), POLES, rtol=1e-6)
    assert float(found.model.c) == pytest.approx(C, rel=1e-6)
    assert found.simulation_rms < 1e-6
    assert found.model.scheme == scheme


def test_the_record_determines_the_bounds_of_c(short):
    found = least_squares(short)
    assert float(found.model.c) == pytest.approx(C, rel=1e-6)


def test_a_given_c_is_kept(short):
    found = least_squares(short, c=-0.04)
    assert float(found.model.c) == -0.04
    assert found.simulation_rms > 1e-3


def test_the_wrong_scheme_leaves_an_error(short):
    trapezoid = least_squares(short, c=BOUNDS)
    voros = least_squares(short, Orders(scheme="voros"), c=BOUNDS)
    assert voros.simulation_rms > 1e3 * trapezoid.simulation_rms


def test_samples_outside_training_do_not_change_the_fit(short):
    spoiled = Record(
        short.input,
        np.where(np.arange(short.samples) < 3000, short.output, 99.0),
        short.dt,
    )
    part = slice(100, 3000)
    for estimator in (least_squares, instrumental_variables):
        found = estimator(spoiled, train=part, c=C)
        expected = estimator(short, train=part, c=C)
        np.testing.assert_allclose(numbers(found.model), numbers(expected.model))


# Under 12 nm of noise


@pytest.fixture(scope="module")
def noisy():
    return [record_of(seed=seed) for seed in range(DRAWS)]


@pytest.fixture(scope="module")
def refined(noisy):
    # One full search; for the other draws the bounds are narrow.
    first = instrumental_variables(noisy[0], c=BOUNDS)
    near = (1.02 * float(first.model.c), 0.98 * float(first.model.c))
    return [
        first,
        *(instrumental_variables(record, c=near) for record in noisy[1:]),
    ]


@pytest.fixture(scope="module")
def plain(noisy):
    return least_squares(noisy[0], c=BOUNDS)


def test_least_squares_is_biased(plain):
    found = poles(plain.model)
    assert abs(found[0] / POLES[0] - 1.0) > 0.5  # far beyond 1 %: it is negative
    assert found[0] < 0.0
    for i, name in enumerate(truth().autoregressive):
        away = abs(float(plain.model.autoregressive[i]) - float(name))
        assert away > 50.0 * float(plain.standard_errors.autoregressive[i])


def test_least_squares_is_biased_at_the_true_c(noisy):
    found = poles(least_squares(noisy[0], c=C).model)
    assert abs(found[0] / POLES[0] - 1.0) > 0.5


def test_instrumental_variables_are_unbiased(refined):
    for found in refined:
        np.testing.assert_allclose(poles(found.model), POLES, rtol=0.01)
        assert float(found.model.c) == pytest.approx(C, rel=0.02)


def test_the_residual_of_instrumental_variables_is_the_noise(refined, plain):
    for found in refined:
        assert found.simulation_rms == pytest.approx(p753.NOISE_RMS, rel=0.02)
    assert plain.simulation_rms > 3.0 * p753.NOISE_RMS
    assert plain.one_step_rms < refined[0].one_step_rms  # the minimised error


def test_standard_errors_cover_the_true_values(refined):
    away = np.array(
        [
            (numbers(fit.model) - numbers(truth())) / numbers(fit.standard_errors)
            for fit in refined
        ]
    )[:, :-1]  # all except the rest point, which is not fitted
    assert np.all(np.isfinite(away))
    assert 0.5 < np.sqrt(np.mean(away**2)) < 2.0
    assert np.max(np.abs(away)) < 5.0


def test_standard_errors_without_a_theory_are_missing(plain, refined):
    assert np.isnan(plain.standard_errors.c)
    assert np.isnan(refined[0].standard_errors.rest_input)


def test_the_estimate_is_a_plant_and_is_saved(refined, tmp_path):
    model = refined[0].model
    save(model, tmp_path / "model.toml")
    voltage = jnp.asarray(decaying_triangles(0.1))
    np.testing.assert_array_equal(
        free_run(load(tmp_path / "model.toml"), voltage, 0.0),
        free_run(model, voltage, 0.0),
    )


# Sample by sample


@pytest.mark.parametrize("seed", [None, 3])
def test_recursive_least_squares_ends_at_the_batch_estimate(seed):
    record = record_of(seed=seed, duration=0.2, offset=-1.5)
    models = recursive_least_squares(record, RecursiveLeastSquares(C, prior=1e12))
    batch = least_squares(record, train=slice(1, None), c=C).model
    end = jax.tree.map(lambda leaf: leaf[-1], models)
    np.testing.assert_allclose(numbers(end)[1:-1], numbers(batch)[1:-1], rtol=1e-5)


def test_a_forgetting_estimator_follows_a_plant_that_changes():
    before, after = truth(), truth()
    after = HystereticARMA(
        after.c,
        (1.5, -0.55),
        [2.0 * b for b in after.moving_1],
        [2.0 * b for b in after.moving_2],
    )
    voltage = jnp.asarray(decaying_triangles(0.4))
    half = voltage.size // 2
    first = free_run(before, voltage, 0.0)
    second = free_run(after, voltage, 0.0)
    record = Record(
        np.asarray(voltage),
        np.concatenate([first[:half], second[half:]]),
        p753.DT,
    )
    ends = {}
    for forgetting in (1.0, 0.99):
        models = recursive_least_squares(
            record, RecursiveLeastSquares(C, forgetting, prior=1e8)
        )
        np.testing.assert_allclose(
            models.autoregressive[0][half - 2], 1.6035, rtol=1e-3
        )
        ends[forgetting] = float(models.autoregressive[0][-1])
    assert ends[0.99] == pytest.approx(1.5, rel=1e-3)
    assert abs(ends[1.0] - 1.5) > 0.05


def test_one_step_equals_one_step_of_the_run(short):
    estimator = RecursiveLeastSquares(C, 0.98, prior=10.0)
    models = recursive_least_squares(short, estimator)
    state = estimator.init(Measured(short.input[0], short.output[0]))
    for k in range(1, 4):
        seen = Measured(short.input[k - 1], short.output[k])
        state, model = estimator.step(state, seen)
    third = jax.tree.map(lambda leaf: leaf[2], models)
    np.testing.assert_allclose(numbers(model), numbers(third), rtol=1e-9, atol=1e-12)


# Refused input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"c": 0.1}, "c in 1/V is 0.1; it must be finite and below 0"),
        ({"c": (-0.01, -0.1)}, "c is searched from -0.01 to -0.1 1/V; both must be"),
        ({"c": (-0.1, 0.0)}, "c is searched from -0.1 to 0 1/V"),
        ({"train": slice(7, 7)}, "train is 7:7; it must hold some of 4000 samples"),
        ({"train": slice(0, 9)}, "train holds 9 samples; 9 coefficients need more"),
    ],
)
@pytest.mark.parametrize("estimator", [least_squares, instrumental_variables])
def test_bad_requests(short, estimator, options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        estimator(short, **options)


def test_a_constant_input_is_refused(short):
    still = np.where(np.arange(short.samples) < 2000, 0.0, short.input)
    record = Record(still, short.output, short.dt)
    with pytest.raises(ValueError, match="does not determine the coefficients"):
        least_squares(record, train=slice(0, 1900), c=C)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"forgetting": 0.0}, "forgetting is 0; it must be finite and above 0 and at"),
        ({"forgetting": 1.1}, "forgetting is 1.1"),
        ({"prior": 0.0}, "prior variance is 0; it must be finite and above 0"),
        ({"moving": 0}, "moving coefficients is 0; it must be finite and at least 1"),
        ({"scheme": "euler"}, "scheme 'euler'"),
        ({"c": 0.2}, "c in 1/V is 0.2"),
    ],
)
def test_bad_recursive_estimators(options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        RecursiveLeastSquares(**{"c": C} | options)


def test_runs_that_overflow_are_refused_without_a_warning():
    class Diverging(_Problem):
        def __init__(self):
            pass

        def error(self, c, theta):
            return np.full(3, 1e200)

    with pytest.raises(ValueError, match="no c in its bounds led to a finite"):
        _search(Diverging(), lambda c, near=None: np.zeros(1), (-2.0, -1.0))
