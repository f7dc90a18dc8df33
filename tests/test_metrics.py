import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.core.feedback import LoopSample
from piezojax.core.metrics import Extremes, MetricPair, Tracking, root

SAMPLES = 300


def record(seed=10):
    """Return a synthetic run, which needs no loop."""
    draw = np.random.default_rng(seed).normal
    reference, voltage = 5.0 + draw(size=SAMPLES), 20.0 * draw(size=SAMPLES)
    displacement = reference + 0.1 * draw(size=SAMPLES)
    shortfall = np.random.default_rng(seed).choice([0.0, 0.05, 30.0], SAMPLES)
    measured = displacement + 0.01 * draw(size=SAMPLES)
    columns = reference, displacement, measured, voltage + shortfall, voltage
    return LoopSample(*map(jnp.array, columns))


@jax.jit
def figures(metric, samples):
    def add(carry, sample):
        total, index = carry
        return (metric.update(total, index, sample), index + 1), None

    (total, _), _ = jax.lax.scan(add, (metric.init(), 0), samples)
    return metric.result(total)


@pytest.mark.parametrize("start", [0, 1, 100, SAMPLES - 1])
def test_figures_count_the_window(start):
    run = record()
    found = figures(Tracking(start), run)
    error = np.asarray(run.displacement - run.reference)[start:]
    whole = np.asarray(run.voltage)
    voltage = whole[start:]
    # A change counts if both of its samples are in the window.
    changes = np.diff(voltage)
    expected = {
        "rms_error": np.sqrt(np.mean(error**2)),
        "peak_error": np.abs(error).max(),
        "rms_effort": np.sqrt(np.mean(voltage**2)),
        "rms_slew": np.sqrt(np.sum(changes**2) / error.size),
        "saturated": np.mean((np.asarray(run.command) - whole) > 0.1),
        "peak_voltage": np.abs(whole).max(),
    }
    assert set(expected) == set(found._fields)
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-12, atol=1e-15)


def test_a_run_without_samples_saturates_nowhere():
    metric = Tracking(0)
    assert metric.result(metric.init()).saturated == 0.0


def test_a_run_without_counted_samples_has_nan_figures():
    found = figures(Tracking(SAMPLES), record())
    assert all(np.isnan(found[:4]))
    assert all(np.isfinite(found[4:]))


def test_the_tolerance_defines_saturation():
    run = record()
    shortfall = np.abs(run.command - run.voltage)
    for tolerance in (0.01, 0.1, 50.0):
        found = figures(Tracking(tolerance=tolerance), run).saturated
        np.testing.assert_allclose(found, np.mean(shortfall > tolerance), rtol=1e-12)
    assert figures(Tracking(tolerance=0.01), run).saturated > 0.5


def test_a_run_of_one_sample_saturates_entirely():
    run = jax.tree.map(lambda x: x[:1], record())
    assert figures(Tracking(tolerance=0.0), run).saturated == 1.0


def test_saturation_counts_at_both_limits():
    run = record()
    mirrored = run._replace(command=-run.command, voltage=-run.voltage)
    assert figures(Tracking(), run) == figures(Tracking(), mirrored)


def test_gradient_at_zero_error_is_zero():
    run = record()
    run = run._replace(
        displacement=run.reference, voltage=0.0 * run.voltage, command=0.0 * run.command
    )

    def total(displacement, voltage):
        found = figures(
            Tracking(), run._replace(displacement=displacement, voltage=voltage)
        )
        return sum(found)

    assert float(total(run.displacement, run.voltage)) == 0.0
    for slope in jax.grad(total, argnums=(0, 1))(run.displacement, run.voltage):
        assert np.all(np.isfinite(slope))
    smooth = jax.grad(
        lambda d: figures(Tracking(), run._replace(displacement=d)).rms_error
    )
    np.testing.assert_array_equal(smooth(run.displacement), np.zeros(SAMPLES))


def test_gradient_equals_the_closed_form():
    run = record()
    slope = jax.grad(
        lambda d: figures(Tracking(100), run._replace(displacement=d)).rms_error
    )(run.displacement)
    error = np.array(run.displacement - run.reference)
    error[:100] = 0.0
    rms = np.sqrt(np.sum(error**2) / 200)
    np.testing.assert_allclose(slope, error / (200 * rms), rtol=1e-12)


def test_figures_are_float64():
    found = figures(Tracking(), record())
    assert {value.dtype for value in found} == {jnp.dtype("float64")}


def test_extremes_cover_the_whole_run():
    run = record()
    found = figures(Extremes(), run)
    swing = np.ptp(run.reference)
    beyond = max(
        np.max(run.displacement) - np.max(run.reference),
        np.min(run.reference) - np.min(run.displacement),
    )
    np.testing.assert_allclose(found.peak_slew, np.abs(np.diff(run.voltage)).max())
    changes = np.abs(np.diff(run.voltage))
    start = int(np.argmax(changes)) + 1  # leaves the largest change out
    later = figures(Extremes(start), run)
    np.testing.assert_allclose(later.peak_slew, changes[start:].max())
    assert later.peak_slew < found.peak_slew
    assert later.overshoot == found.overshoot
    np.testing.assert_allclose(found.overshoot, beyond / swing, rtol=1e-12)
    assert beyond > 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_overshoot_is_counted_on_both_sides(side):
    run = record()
    swing = np.ptp(run.reference)
    moved = run._replace(displacement=run.reference + side)
    assert figures(Extremes(), moved).overshoot == pytest.approx(1.0 / swing)


def test_there_is_no_overshoot_within_the_references_or_at_rest():
    run = record()
    within = run._replace(displacement=0.9 * run.reference + 0.5)
    assert figures(Extremes(), within).overshoot == 0.0
    still = run._replace(reference=jnp.full(SAMPLES, 1.0))
    assert figures(Extremes(), still).overshoot == 0.0


def test_a_pair_of_metrics_gives_both_figures():
    run, first, second = record(), Tracking(100), Extremes()
    found = figures(MetricPair(first, second), run)
    assert found == (figures(first, run), figures(second, run))


def test_the_root_has_slope_zero_at_zero():
    assert root(jnp.asarray(9.0)) == 3.0
    assert root(jnp.asarray(0.0)) == jax.grad(root)(0.0) == 0.0
    assert np.isnan(root(jnp.asarray(np.nan)))
    # A difference of squares may be negative by rounding.
    assert root(jnp.asarray(-1e-18)) == 0.0
