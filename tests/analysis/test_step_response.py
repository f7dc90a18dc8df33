"""Figures of steps against closed forms and python-control."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.analysis.step_response import figures_of, step_ends, step_figures
from piezojax.catalog import p753

DT = 1e-5
TAU = 2e-3
ENDS = (3.0, -1.0)
"""A step down by 4 um."""


def run(share):
    """Return the displacement for the step response ``share`` [samples]."""
    moved = ENDS[0] + (ENDS[1] - ENDS[0]) * np.asarray(share)
    return jnp.asarray(np.concatenate([[ENDS[0]], moved]))


def figures(share, noise=0.0):
    return figures_of(run(share), jnp.asarray(ENDS), DT, noise)


def test_a_first_order_lag():
    time = DT * np.arange(4_000)
    found = figures(1.0 - np.exp(-time / TAU), noise=0.04)
    assert found.rise_time == pytest.approx(TAU * np.log(9.0), rel=1e-4)
    assert found.settling_time == pytest.approx(TAU * np.log(50.0), rel=1e-4)
    assert found.settling_time_fine == pytest.approx(TAU * np.log(1000.0), rel=1e-4)
    # A noise of 40 nm is 1 % of the step.
    assert found.settling_time_noise == pytest.approx(TAU * np.log(100.0), rel=1e-4)
    assert found.overshoot == 0.0
    assert found.steady_state_error < 1e-7


@pytest.mark.parametrize("damping", [0.1, 0.3, 0.7])
def test_a_mode_equals_that_of_python_control(damping):
    w = 2.0 * np.pi * 100.0
    system = control.tf([w**2], [1.0, 2.0 * damping * w, w**2])
    time = DT * np.arange(20_000)
    _, y = control.step_response(system, time)
    found = figures(y)
    expected = control.step_info(y, time, final_output=1.0)
    assert found.rise_time == pytest.approx(expected["RiseTime"], abs=2 * DT)
    assert found.settling_time == pytest.approx(expected["SettlingTime"], abs=2 * DT)
    over = np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2))
    assert found.overshoot == pytest.approx(over, rel=1e-3)


def test_an_unsettled_step_has_settling_time_beyond_the_run():
    near, far = figures(np.full(1_000, 0.95)), figures(np.full(1_000, 0.5))
    assert 1_000 * DT < near.settling_time < far.settling_time
    assert far.rise_time > 1_000 * DT
    assert far.steady_state_error == pytest.approx(0.5)
    # At 89 % the rise is incomplete too; its time slightly exceeds the run.
    short = figures(np.full(1_000, 0.89))
    assert 1_000 * DT < short.rise_time < far.rise_time


@pytest.mark.parametrize(
    "share",
    [
        np.full(1_000, -0.1),
        np.full(1_000, 0.05),
        np.concatenate([np.zeros(999), [0.89]]),
        np.full(1_000, 0.8999),
    ],
)
def test_a_step_below_nine_tenths_rises_longer_than_the_run(share):
    def rise(scale):
        moved = ENDS[0] + (ENDS[1] - ENDS[0]) * scale * jnp.asarray(share)
        moved = jnp.concatenate([jnp.asarray(ENDS[:1]), moved])
        return figures_of(moved, jnp.asarray(ENDS), DT, 0.0).rise_time

    value, slope = jax.value_and_grad(rise)(1.0)
    highest = np.max(share)
    assert value == pytest.approx(1_000 * DT * (1.9 - highest))
    assert value > 1_000 * DT
    assert slope == pytest.approx(-1_000 * DT * highest)


def test_a_diverging_step_has_finite_figures():
    found = figures(np.concatenate([np.ones(10), np.full(990, np.nan)]))
    assert all(np.isfinite(value) for value in found)
    assert found.overshoot > 1e5
    low = figures(np.concatenate([np.full(10, 0.05), np.full(990, np.nan)]))
    assert low.rise_time > 1_000 * DT


def test_the_steps_span_nine_tenths_of_the_references():
    references = np.stack([np.linspace(0.0, 10.0, 101), np.linspace(0.0, 10.0, 101)])
    small_up, small_down, up, down = step_ends(references)
    np.testing.assert_allclose(up, [0.5, 9.5])
    np.testing.assert_allclose(down, up[::-1])
    np.testing.assert_allclose(small_up, [4.55, 5.45])
    np.testing.assert_allclose(small_down, small_up[::-1])


def loop(integral):
    return p753.loop(pj.control.PID(0.5, integral, 0.0, 1e-4, 100.0, dt=p753.DT))


def test_each_step_equals_a_run_of_the_loop_and_has_a_gradient():
    ends = jnp.asarray([[4.0, 6.0], [6.0, 4.0]])

    def steps(integral):
        return step_figures(loop(integral), ends, 2_000, p753.DT, 0.012)

    steps = jax.jit(steps)
    found = steps(3000.0)
    for i, (before, after) in enumerate(np.asarray(ends)):
        reference = np.full(2_000, after)
        reference[0] = before
        own = loop(3000.0)
        inputs = pj.loop_inputs(jnp.asarray(reference))
        y = np.asarray(pj.simulate(own, inputs, own.init(before))[1].displacement)
        miss = np.abs(y[1:] - after) / abs(after - before)
        last = np.flatnonzero(miss > 0.02)[-1]
        assert last * p753.DT < found.settling_time[i] < (last + 1) * p753.DT
        beyond = (y - after) * np.sign(after - before)
        assert found.overshoot[i] == pytest.approx(beyond.max() / 2.0, abs=1e-9)
    step = 1e-2
    difference = jax.tree.map(
        lambda high, low: (high - low) / (2.0 * step),
        steps(3000.0 + step),
        steps(3000.0 - step),
    )
    slopes = jax.jit(jax.jacrev(steps))(3000.0)
    for name in ("rise_time", "settling_time", "settling_time_noise"):
        slope, expected = getattr(slopes, name), getattr(difference, name)
        np.testing.assert_allclose(slope, expected, rtol=1e-4)
        assert np.all(expected != 0.0)
