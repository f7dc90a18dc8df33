"""Strokes against closed forms and against a slow motion in NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.analysis.stroke import stroke_of
from piezojax.core.axes import Packed, PerAxis
from piezojax.core.system import Affine, System
from piezojax.dynamics import ARMA, ExponentialCreep, FirstOrderLag, LinearMap
from piezojax.hardware import Quantiser, Saturation, SlewLimit
from piezojax.hysteresis import PrandtlIshlinskii

DT = 1e-4
LOW, HIGH = (-20.0,), (120.0,)


def bounds(found):
    return [*found.lowest, *found.highest]


def driven(weights, radii, lag, samples=20_000):
    """Return the output of plays and a lag from rest to both limits and back."""
    out, plays, y = [], np.zeros(len(radii)), 0.0
    points = (0.0, LOW[0], HIGH[0], LOW[0])
    ramps = [np.linspace(a, b, samples) for a, b in itertools.pairwise(points)]
    for u in np.concatenate(ramps):
        plays = np.clip(plays, u - radii, u + radii)
        y += (1.0 - np.exp(-DT / lag)) * (weights @ plays - y)
        out.append(y)
    return [min(out), max(out)]


def test_hysteresis_and_lag_behind_an_actuator():
    # Over 140 V the slew limit lags far behind a motion of 250 samples.
    actuator = Saturation(-20.0, 120.0) >> SlewLimit(500.0, DT) >> Quantiser(1e-4)
    weights, radii = np.array([0.06, 0.03, 0.01]), np.array([0.0, 5.0, 40.0])
    plays = PrandtlIshlinskii(weights[:1], radii[1:], weights[1:])
    stage = actuator >> plays >> FirstOrderLag(2e-3, DT)
    found = bounds(stroke_of(stage, LOW, HIGH))
    assert found == pytest.approx(driven(weights, radii, 2e-3), rel=2e-3)


def test_the_limits_of_the_actuator_bound_the_stroke():
    stage = Saturation(-10.0, 30.0) >> Affine(0.5, 1.0)
    assert bounds(stroke_of(stage, LOW, HIGH)) == pytest.approx([-4.0, 16.0])
    falling = Saturation(-10.0, 30.0) >> Affine(-0.5, 1.0)
    assert bounds(stroke_of(falling, LOW, HIGH)) == pytest.approx([-14.0, 6.0])


def test_the_stroke_includes_all_creep():
    # The motion takes 25 ms, the slowest creep 100 s.
    stage = ExponentialCreep((0.1, 0.2), (1.0, 100.0), DT, direct=0.5)
    assert bounds(stroke_of(stage, LOW, HIGH)) == pytest.approx([-16.0, 96.0])


def test_coupled_axes():
    gains = np.array([[1.0, -0.3], [0.2, 2.0]])
    lower, upper = np.array([-1.0, 0.0]), np.array([3.0, 10.0])
    ends = [[a, b] for a in (lower[0], upper[0]) for b in (lower[1], upper[1])]
    corners = np.array(ends) @ gains.T
    stage = PerAxis((Affine(), Affine())) >> Packed(LinearMap(gains))
    found = stroke_of(stage, tuple(lower), tuple(upper))
    np.testing.assert_allclose(found.lowest, corners.min(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.highest, corners.max(axis=0), rtol=1e-12)


class Parabola(System):
    """A static map whose output is largest within the limits."""

    def init(self, input=None):
        return ()

    def step(self, state, input):
        return state, input * (100.0 - input)


def test_an_extreme_between_the_limits_belongs_to_the_stroke():
    found = bounds(stroke_of(Parabola(), LOW, HIGH))
    assert found == pytest.approx([-2400.0, 2500.0], abs=0.2)


class Shared(System):
    """Two axes that share one supply: each moves less when both are driven."""

    def init(self, input=None):
        return ()

    def step(self, state, input):
        load = 1.0 + jnp.abs(input[0]) + jnp.abs(input[1])
        return state, tuple(x / load for x in input)


def test_the_stroke_of_an_axis_is_that_of_driving_it_alone():
    found = stroke_of(Shared(), (-1.0, -1.0), (1.0, 1.0))
    np.testing.assert_allclose(found.highest, 0.5)
    np.testing.assert_allclose(found.lowest, -0.5)


class Walking(System):
    """A stage of 1 um/V with noise and drift."""

    drift: float
    noise: float

    def init(self, input=0.0):
        return jax.random.key(0), jnp.zeros(())

    def step(self, state, input):
        key, moved = state
        key, draw = jax.random.split(key)
        moved = moved + self.drift
        return (key, moved), input + moved + self.noise * jax.random.normal(draw)


@pytest.mark.parametrize(("drift", "noise"), [(1e-3, 0.0), (-1e-3, 0.0), (0.0, 0.1)])
def test_noise_and_drift_do_not_change_the_stroke(drift, noise):
    lowest, highest = bounds(stroke_of(Walking(drift, noise), LOW, HIGH))
    least = 3.0 * noise + 1e-2
    assert lowest < LOW[0] + least
    assert highest > HIGH[0] - least


def test_a_stage_without_rest_has_no_bounds():
    integrator = ARMA((1.0,), (1.0,))
    assert bounds(stroke_of(integrator, LOW, HIGH)) == [-np.inf, np.inf]


class Relative(System):
    """Two axes that measure their motion from the place where they start."""

    def init(self, input=None):
        return input

    def step(self, state, input):
        load = 1.0 + sum(jnp.abs(x) for x in input)
        return state, tuple((x - x0) / load for x, x0 in zip(input, state, strict=True))


def test_an_axis_is_driven_alone_from_both_of_its_limits():
    found = stroke_of(Relative(), (-1.0, -1.0), (1.0, 1.0))
    np.testing.assert_allclose(found.highest, 1.0)
    np.testing.assert_allclose(found.lowest, -1.0)


class Runaway(System):
    """A stage without displacement above 100 V."""

    def init(self, input=None):
        return ()

    def step(self, state, input):
        return state, jnp.where(input > 100.0, jnp.inf, input)


def test_an_axis_that_is_infinite_at_one_end_has_no_bounds():
    assert bounds(stroke_of(Runaway(), LOW, HIGH)) == [-np.inf, np.inf]


def test_one_axis_without_bounds_does_not_affect_the_other():
    lost = PerAxis((Affine(2.0), ARMA((1.0,), (1.0,))))
    found = stroke_of(lost, (-1.0, -1.0), (1.0, 1.0))
    np.testing.assert_array_equal(found.lowest, [-2.0, -np.inf])
    np.testing.assert_array_equal(found.highest, [2.0, np.inf])
