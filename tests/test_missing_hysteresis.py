"""Assumed hysteresis against Rayleigh's law in closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezojax.signals.missing_hysteresis import missing_hysteresis, steepest

TIME = np.linspace(0.0, 3.0, 3001)
HALF, WIDTH = 3.0, 0.15
WHOLE = 5.0 - HALF * np.cos(2.0 * np.pi * TIME)
"""Three periods over the whole span; the last begins at sample 2000."""


def in_closed_form(travelled):
    """Return the deviation since the last turn: c s^2 / 4, with c = 4 width / HALF."""
    return (4.0 * WIDTH / HALF) * travelled**2 / 4.0


def test_branches_are_the_parabolas_of_rayleigh():
    (deviation,) = missing_hysteresis(WHOLE[None], WIDTH)
    for begin, sign in ((0, 1.0), (500, -1.0), (2000, 1.0), (2500, -1.0)):
        branch = slice(begin, begin + 501)
        travelled = np.abs(WHOLE[branch] - WHOLE[begin])
        np.testing.assert_allclose(
            deviation[branch] - deviation[begin],
            sign * in_closed_form(travelled),
            atol=1e-3 * 2.0 * HALF,
        )


def test_the_loop_has_the_width():
    """The mean gain is 1, that for small motions 1 - 2 width."""
    deviation = missing_hysteresis(WHOLE[None], WIDTH)[0]
    displacement = (1.0 - 2.0 * WIDTH) * WHOLE + deviation
    height = np.ptp(displacement[2000:])
    assert height == pytest.approx(2.0 * HALF, rel=1e-3)
    rising, falling = displacement[2250], displacement[2750]
    assert falling - rising == pytest.approx(WIDTH * height, rel=1e-3)


def test_a_smaller_reference_has_a_narrower_loop():
    """Its relative width is in proportion to its span."""
    small = 5.0 - 0.25 * HALF * np.cos(2.0 * np.pi * TIME)
    deviation = missing_hysteresis(np.stack([WHOLE, small]), WIDTH)[1]
    gap = deviation[2750] - deviation[2250]
    assert gap == pytest.approx(WIDTH / 4.0 * 2.0 * HALF / 4.0, rel=0.03)


def test_the_stage_has_come_from_the_farther_end():
    low, high = np.linspace(3.0, 6.0, 301), np.linspace(7.0, 4.0, 301)
    span = np.array([2.0, 8.0])  # of all references
    both = np.stack([low, high, np.resize(span, 301)])
    rising, falling, _ = missing_hysteresis(both, WIDTH)
    # Each begins with the first motion after a turn.
    np.testing.assert_allclose(rising, in_closed_form(low - 3.0), atol=6e-3)
    np.testing.assert_allclose(falling, -in_closed_form(7.0 - high), atol=6e-3)


@given(st.floats(0.0, 0.49), st.floats(0.1, 10.0), st.integers(0, 20))
def test_deviations_begin_at_zero_and_scale_with_each_axis(width, scale, seed):
    references = np.random.default_rng(seed).normal(size=(2, 30, 2))
    found = missing_hysteresis(references, width)
    assert found.shape == references.shape
    assert np.all(found[:, 0] == 0.0)
    scaled = missing_hysteresis(references * [1.0, scale] + [0.0, 7.0], width)
    np.testing.assert_allclose(scaled, found * [1.0, scale], atol=1e-9)
    span = np.ptp(references, axis=(0, 1))
    assert np.all(np.abs(found) <= 4.0 * width * span)


def test_the_steepest_gain_is_that_at_the_end_of_a_branch():
    (deviation,) = missing_hysteresis(WHOLE[None], WIDTH)
    displacement = (1.0 - 2.0 * WIDTH) * WHOLE + deviation
    gain = np.diff(displacement[2000:2500]) / np.diff(WHOLE[2000:2500])
    ratio = np.max(gain[1:-1]) / (1.0 - 2.0 * WIDTH)
    assert ratio == pytest.approx(steepest(WIDTH), rel=0.02)


def test_a_constant_reference_has_no_deviation():
    assert np.all(missing_hysteresis(np.full((1, 50), 4.0), 0.3) == 0.0)
