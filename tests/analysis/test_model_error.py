"""Worst margins for a model error, against an exhaustive grid of errors and delays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.analysis.stability.model_error import (
    NEAR_ONE,
    worst_delay_margin,
    worst_sensitivity,
)
from piezojax.analysis.stability.sampled_margins import UNLIMITED_DELAY
from piezojax.core.error_bound import ErrorBound

RANDOM = np.random.default_rng(3)
LINES = 40
ANGLE = np.linspace(0.05, np.pi, LINES)
L = RANDOM.uniform(0.05, 4.0, LINES) * np.exp(2j * np.pi * RANDOM.uniform(size=LINES))
S = 1.0 / (1.0 + L)
BOUND = RANDOM.uniform(0.0, 0.8, LINES)
TURNS = np.exp(2j * np.pi * np.arange(720) / 720)


def test_worst_sensitivity_is_the_largest_over_errors():
    share = BOUND * np.abs(1.0 - S)
    inside = share < NEAR_ONE
    assert 10 < inside.sum() < LINES  # the lines include both kinds
    found = np.asarray(worst_sensitivity(jnp.asarray(S), jnp.asarray(BOUND)))
    errors = BOUND[:, None] * TURNS
    sampled = np.max(np.abs(1.0 / (1.0 + L[:, None] * (1.0 + errors))), axis=1)
    ratio = found[inside] / sampled[inside]
    assert np.all(ratio >= 1.0 - 1e-12)
    # The grid of angles misses the worst angle by at most half a step.
    near = share[inside] < 0.9
    np.testing.assert_allclose(ratio[near], 1.0, rtol=2e-3)
    assert np.all(found[~inside] > 1.0 / (1.0 - NEAR_ONE) - 1e-6)
    assert np.all(np.isfinite(found))


def test_a_zero_error_does_not_change_the_sensitivity():
    found = worst_sensitivity(jnp.asarray(S), jnp.zeros(LINES))
    np.testing.assert_allclose(found, np.abs(S), rtol=1e-12)


def test_worst_sensitivity_grows_beyond_instability():
    shares = jnp.asarray([0.98, 0.99, 1.0, 2.0, 25.0])
    found = np.asarray(worst_sensitivity(jnp.full(5, 0.5 + 0j), 2.0 * shares))
    assert np.all(np.diff(found) > 0.0)
    assert found[-1] < 1e7


def closest(line, bound, delays):
    """Return the least |1 + L (1 + D) exp(-j w tau)| over D, by delay."""
    turned = L[line] * np.exp(-1j * ANGLE[line] * delays)
    # The edge and the inside of the discs: radii from 0 to the bound.
    errors = (bound * np.linspace(0.0, 1.0, 41)[:, None] * TURNS).ravel()
    return np.array([np.abs(1.0 + one * (1.0 + errors)).min() for one in turned])


@pytest.mark.parametrize("line", range(0, LINES, 4))
def test_worst_delay_margin_is_the_smallest_delay_that_can_be_unstable(line):
    bound = BOUND[line]
    found = float(
        worst_delay_margin(
            jnp.asarray(S[line : line + 1]),
            jnp.asarray([bound]),
            jnp.asarray(ANGLE[line : line + 1]),
        )[0]
    )
    around = float(2.0 * np.pi / ANGLE[line])
    delays = np.linspace(0.0, around, 241)
    # The error of a zero on the grid of D is at most its step times |L|.
    zero = closest(line, bound, delays) < 0.03 * bound * abs(L[line])
    if found == UNLIMITED_DELAY:
        assert not zero.any()
    else:
        assert delays[np.argmax(zero)] == pytest.approx(found, abs=0.03 * around)
        assert zero.any()


def test_the_cases_cover_all_three_outcomes_of_a_delay():
    found = np.asarray(worst_delay_margin(*map(jnp.asarray, (S, BOUND, ANGLE))))[::4]
    assert (found == UNLIMITED_DELAY).any()
    assert (found == 0.0).any()
    assert ((found > 0.0) & (found < UNLIMITED_DELAY)).any()


def test_a_delay_reaches_the_critical_point_exactly():
    found = np.asarray(worst_delay_margin(*map(jnp.asarray, (S, BOUND, ANGLE))))
    finite = (found > 0.0) & (found < UNLIMITED_DELAY)
    point = -1.0 / L[finite] * np.exp(1j * ANGLE[finite] * found[finite])
    np.testing.assert_allclose(np.abs(point - 1.0), BOUND[finite], rtol=1e-6)


@pytest.mark.parametrize(
    ("sensitivity", "bound", "expected"),
    [(0.0, 0.5, UNLIMITED_DELAY), (0.0, 1.5, 0.0), (1.0, 25.0, UNLIMITED_DELAY)],
)
def test_loops_with_infinite_and_zero_gain(sensitivity, bound, expected):
    arguments = (jnp.asarray([sensitivity + 0j]), jnp.asarray([bound]))
    assert worst_delay_margin(*arguments, jnp.zeros(1))[0] == expected
    assert worst_delay_margin(*arguments, jnp.ones(1))[0] == expected


@pytest.mark.parametrize("loop", [-0.1, -1e-6, 0.1])
def test_a_small_loop_gain_of_phase_zero_needs_a_delay(loop):
    # At the Nyquist frequency L is real; a negative L is far from -1 here.
    arguments = (jnp.asarray([1.0 / (1.0 + loop) + 0j]), jnp.asarray([5.0]))
    assert worst_delay_margin(*arguments, jnp.full(1, np.pi))[0] == UNLIMITED_DELAY


@pytest.mark.parametrize("figure", ["sensitivity", "delay"])
def test_gradients_equal_finite_differences(figure):
    def value(scale):
        loop = 1.0 / (1.0 + scale * jnp.asarray(L))
        if figure == "sensitivity":
            return jnp.log(worst_sensitivity(loop, jnp.asarray(BOUND)))
        delay = worst_delay_margin(loop, jnp.asarray(BOUND), jnp.asarray(ANGLE))
        return jnp.where(delay < UNLIMITED_DELAY, delay, 0.0)

    slope = np.asarray(jax.jacfwd(value)(1.0))
    ends = (value(1.0 + 1e-6) - value(1.0 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, ends, rtol=1e-4, atol=1e-6)
    assert np.any(slope != 0.0)


BOUNDS = ErrorBound(
    frequency=(0.0, 10.0, 20.0, 50.0),
    relative=(0.1, 0.3, 0.2, 25.0),
    excited=(True, True, True, False),
)


def test_a_bound_between_two_lines_is_the_larger_of_both():
    asked = [-1.0, 0.0, 5.0, 10.0, 15.0, 20.0, 21.0, 60.0]
    expected = [0.1, 0.1, 0.3, 0.3, 0.3, 0.2, 25.0, 25.0]
    np.testing.assert_array_equal(BOUNDS.at(asked), expected)
    np.testing.assert_array_equal(BOUNDS.excited_at(asked), [True] * 6 + [False, False])


def test_a_search_respects_the_largest_bound_of_each_cell():
    found = BOUNDS.supported(np.array([0.0, 16.0, 32.0]))
    np.testing.assert_array_equal(found, [0.3, 25.0, 25.0])


def test_a_narrow_record_bounds_nothing_above_its_band():
    narrow = ErrorBound(
        frequency=(1.0, 2.0, 3.0, 100.0),
        relative=(0.1, 0.3, 5.0, 25.0),
        excited=(True, True, False, False),
    )
    assert narrow.highest == 2.0
    found = narrow.supported(np.array([1.0, 2.0, 3.0, 4.0]))
    np.testing.assert_array_equal(found, [0.3, 0.0, 0.0, 0.0])


def test_a_bound_is_saved_and_loaded():
    assert ErrorBound.model_validate(BOUNDS.model_dump(mode="json")) == BOUNDS
    assert ErrorBound.model_validate_json(BOUNDS.model_dump_json()) == BOUNDS


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"relative": (0.1,)}, "relative has 1 lines and frequency 4"),
        ({"excited": (True,)}, "excited has 1 lines and frequency 4"),
        ({"frequency": (0.0, 10.0, 10.0, 20.0)}, "frequency must increase"),
        ({"relative": (0.1, -1.0, 0.1, 0.1)}, "greater than or equal to 0"),
        ({"relative": (0.1, np.nan, 0.1, 0.1)}, "finite number"),
    ],
)
def test_bad_bounds_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ErrorBound.model_validate(BOUNDS.model_dump() | change)
