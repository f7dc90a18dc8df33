"""Effective samples, AIC, BIC and their ranking, against closed forms."""

import numpy as np
import pytest

from piezojax.identification.criteria import (
    correlation_time,
    criteria,
    effective_samples,
    first_equivalent,
    ranking,
    validates_as_well,
)


def autoregressive(pole, size, seed=0):
    """Return a first-order autoregressive process with the correlation pole^lag."""
    draws = np.random.default_rng(seed).standard_normal(size)
    found = np.empty(size)
    last = 0.0
    for k in range(size):
        last = found[k] = pole * last + draws[k]
    return found


@pytest.mark.parametrize("pole", [0.0, 0.5, 0.9, 0.98])
def test_the_correlation_time_of_an_autoregressive_process(pole):
    expected = (1.0 + pole) / (1.0 - pole)
    found = correlation_time(autoregressive(pole, 100_000))
    assert found == pytest.approx(expected, rel=0.1)


def test_the_correlation_time_predicts_the_variance_of_a_mean():
    # the purpose of an effective number of samples, on independent draws
    rows = np.stack([autoregressive(0.9, 2000, seed) for seed in range(300)])
    worth = np.mean([row.size / correlation_time(row) for row in rows])
    assert np.var(rows.mean(axis=1)) == pytest.approx(np.var(rows) / worth, rel=0.25)


@pytest.mark.parametrize("size", [2, 3, 51])
def test_the_correlation_time_of_short_and_of_alternating_signals(size):
    assert correlation_time(np.zeros(size)) == 1.0
    assert correlation_time((-1.0) ** np.arange(size)) == 1.0
    assert 1.0 <= correlation_time(np.arange(size)) <= size


def test_effective_samples_add_up_over_records():
    white = np.random.default_rng(1).standard_normal((400, 2))
    (one, _), both = effective_samples([white]), effective_samples([white, white])
    assert both == pytest.approx(2.0 * effective_samples([white]))
    assert 200 < one <= 400


def test_the_criteria_equal_their_formulas():
    found = criteria(np.array([0.25, 4.0]), np.array([80.0, 20.0]), 3)
    misfit = 80.0 * np.log(0.25) + 20.0 * np.log(4.0)
    assert found.aic == pytest.approx(misfit + 6.0)
    assert found.bic == pytest.approx(misfit + 3.0 * np.log(50.0))


def test_a_perfect_fit_has_finite_criteria():
    found = criteria(np.zeros(1), np.ones(1), 2)
    assert np.isfinite(found.aic)
    assert np.isfinite(found.bic)


def test_units_do_not_change_the_penalty_of_a_parameter():
    squares, samples = np.array([0.3]), np.array([70.0])
    for scale in (1.0, 1e6):
        one = criteria(scale * squares, samples, 5)
        other = criteria(scale * 0.9 * squares, samples, 6)
        assert other.bic - one.bic == pytest.approx(70.0 * np.log(0.9) + np.log(70.0))


def test_common_noise_does_not_hide_a_worse_model():
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((4000, 1))
    worse = [noise + 0.2 * rng.standard_normal((4000, 1))]
    # 4 % in mean square, within twice the standard error of either error alone
    assert np.std(noise**2) * np.sqrt(2.0 / 4000) * 2.0 > 0.04
    assert not validates_as_well(worse, [noise])
    assert validates_as_well([noise], worse)
    assert validates_as_well([noise], [noise])


def test_a_correlated_difference_counts_as_few_samples():
    drift = autoregressive(0.99, 2000)
    drift = (drift - np.mean(drift)) / np.std(drift) + 0.3
    best = 2.0 * np.ones((2000, 1))
    # 0.3 deviations are 13 standard errors of white noise and one of this noise.
    assert validates_as_well([np.sqrt(best**2 + 0.5 * drift[:, None])], [best])
    shuffled = np.random.default_rng(5).permutation(drift)
    assert not validates_as_well([np.sqrt(best**2 + 0.5 * shuffled[:, None])], [best])


def test_more_parameters_alone_do_not_win():
    noise = np.random.default_rng(4).standard_normal((500, 1))
    errors = [[noise], [0.999 * noise], [3.0 * noise]]
    training = [1.0, 0.998, 0.5]
    samples = np.array([500.0])
    bics = [
        criteria(np.array([square]), samples, count).bic
        for square, count in zip(training, (5, 25, 5), strict=True)
    ]
    order, well = ranking(bics, [errors[0], errors[0], errors[2]])
    # The third model fits best and simulates worst: it is never chosen.
    assert int(np.argmin(bics)) == 2
    assert order == [0, 1, 2]
    assert well == [True, True, False]


def test_equivalent_models_count_as_one():
    rng = np.random.default_rng(7)
    noise = rng.standard_normal((500, 1))
    near = noise + 0.05 * rng.standard_normal((500, 1))
    other = noise + 0.2 * rng.standard_normal((500, 1))
    errors = [[noise], [near], [other], [near], [near], [noise[:200], near[200:]]]
    bics = [-10.0, -10.9, -10.0, -10.0, -12.1, -10.0]
    counts = [5, 5, 5, 6, 5, 5]
    # Besides the second, one has another run, one another count, one another BIC.
    assert first_equivalent(bics, counts, errors) == [0, 0, 2, 3, 4, 0]


def test_equivalence_is_relative_to_the_first_model():
    # Each model is close to the one before, but the last is not close to the first.
    noise = np.random.default_rng(8).standard_normal((500, 1))
    errors = [[noise * (1.0 + share)] for share in (0.0, 0.08, 0.16)]
    assert first_equivalent([0.0, 0.0, 0.0], [5, 5, 5], errors) == [0, 0, 2]
