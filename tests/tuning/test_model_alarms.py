"""Alarms of a model: its error in the closed loop, and those of its fit."""

import numpy as np
import pytest

import piezojax as pj
from piezojax.analysis.stability import stability_reports
from piezojax.core.about import About
from piezojax.core.error_bound import ErrorBound
from piezojax.tuning.model_alarms import model_alarms, unchecked

RATE, GAIN = 1000.0, 0.1


@pytest.fixture(scope="module")
def stability():
    """Return the report of L = GAIN / (z - 1): integral control of a unit delay."""
    controller = pj.control.PID(
        proportional=0.0, integral=GAIN * RATE, derivative=0.0, dt=1.0 / RATE
    )
    plant = pj.Affine(1.0, 0.0)
    limits = pj.hardware.Saturation(-10.0, 10.0)
    loop = pj.Feedback(controller, plant, limits, pj.hardware.Sensor(0.0))
    return stability_reports({"after": loop}, 0.0, 1.0 / RATE)


def bound(relative, excited):
    return ErrorBound(
        frequency=(1.0, 100.0, 101.0, 500.0), relative=relative, excited=excited
    )


def worst_by_sampling(relative_at):
    """Return the largest |1/(1 + L (1 + D))| over errors D on the circle |D| = l."""
    angle = np.linspace(1e-3, np.pi, 4000)
    L = GAIN / (np.exp(1j * angle) - 1.0)
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 360))[:, None]
    D = relative_at(angle * RATE / (2.0 * np.pi)) * turn
    return np.max(np.abs(1.0 / (1.0 + L * (1.0 + D))))


def test_a_small_error_raises_no_alarm(stability):
    assert (
        list(
            model_alarms(
                About(error_bound=bound((0.05,) * 4, (True,) * 4)),
                False,
                2.0,
                stability,
            )
        )
        == []
    )
    assert list(model_alarms(About(), False, 2.0, stability)) == []


def test_an_unexcited_band_within_the_bandwidth_is_named(stability):
    # |T| is 0.16 at 100 Hz: a hidden resonance of 25 times the gain is too large.
    unseen = bound((0.05, 0.05, 25.0, 25.0), (True, True, False, False))
    (alarm,) = model_alarms(About(error_bound=unseen), False, 2.0, stability)
    assert "the record excites nothing at 10" in alarm
    assert "make the loop unstable" in alarm
    assert "record a chirp" in alarm


def test_the_worst_peak_equals_that_of_sampled_errors(stability):
    (alarm,) = model_alarms(
        About(error_bound=bound((0.6,) * 4, (True,) * 4)), False, 1.05, stability
    )
    expected = worst_by_sampling(lambda frequency: 0.6)
    assert f"raise Ms to {expected:.3g} (limit 1.05)" in alarm
    assert "0.6 times its own gain" in alarm


def test_without_a_limit_on_the_peak_instability_is_an_alarm(stability):
    often, always = (bound((share,) * 4, (True,) * 4) for share in (0.6, 1.5))
    assert list(model_alarms(About(error_bound=often), False, np.inf, stability)) == []
    (alarm,) = model_alarms(About(error_bound=always), False, np.inf, stability)
    assert "make the loop unstable" in alarm


def test_alarms_of_the_fit_and_a_missing_bound_are_alarms(stability):
    about = About(unsafe=["wrong column"])
    first, second = model_alarms(about, True, 2.0, stability)
    assert first == "wrong column"
    assert "gives no bound on the error" in second


def test_a_missing_bound_of_several_axes_has_a_remedy_that_can_be_followed(stability):
    about = About(input_ranges=[(0.0, 1.0)] * 2, residual_rms=[0.1, 0.1, 0.2])
    (alarm,) = model_alarms(about, True, 2.0, stability)
    assert "has 2 inputs and 3 outputs, and no bound on the error" in alarm
    assert "[ensemble]" in alarm
    assert "longer record" not in alarm


def test_an_unchecked_model_has_a_note():
    (note,) = unchecked(About(record="bench.csv"))
    assert "fitted to bench.csv and never checked" in note
    assert "plant.check" in note
    assert unchecked(About(record="bench.csv", checked=["today.csv"])) == []
    assert unchecked(About()) == []
    (note,) = unchecked(About(record="bench.csv"), response=True)
    assert "never checked on a second response" in note
    assert "piezojax.identify --response" in note
