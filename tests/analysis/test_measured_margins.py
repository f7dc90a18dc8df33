"""Margins on measured points, against closed forms and a denser response."""

import re

import control
import numpy as np
import pytest

from piezojax.analysis.stability import StabilityReports, report_of
from piezojax.analysis.stability.conserved import LinearLoop
from piezojax.analysis.stability.measured_margins import (
    MeasuredMargins,
    measured_margins,
)
from piezojax.tuning.response_margins import response_alarms

DT = 1e-3
# L = 0.2 / (z - 1) with two samples of delay: states are the integral and two delays.
A = np.array([[1.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
LOOP = LinearLoop(A, np.array([0.0, 1.0, 0.0]), np.array([0.2, 0.0, 0.0]), DT)
LINES = np.linspace(0.5, 499.0, 4000)


def loop_gain(frequency, gain=0.2):
    z = np.exp(2j * np.pi * frequency * DT)
    return gain / (z - 1.0) / z**2


def test_without_an_error_of_the_model_the_margins_are_those_of_the_loop():
    np.testing.assert_allclose(
        LOOP.response(2.0 * np.pi * LINES * DT), loop_gain(LINES), rtol=1e-9
    )
    exact = report_of(LOOP)
    found = measured_margins(LOOP, LINES, np.ones(4000, complex))
    assert found.stable
    assert exact.stable
    assert found.sensitivity_peak == pytest.approx(exact.sensitivity_peak, rel=1e-4)
    assert found.sensitivity_peak_Hz == pytest.approx(exact.sensitivity_peak_Hz, 5e-3)
    for name in (
        *("gain_margin_dB", "phase_margin_deg", "delay_margin_samples"),
        "disk_margin",
    ):
        assert getattr(found, name) == pytest.approx(getattr(exact, name), rel=1e-3)


def test_the_margins_are_those_of_the_measured_plant():
    """The stage has 1.3 times the model's gain and another half sample of delay."""
    ratio = 1.3 * np.exp(-0.5j * 2.0 * np.pi * LINES * DT)
    found = measured_margins(LOOP, LINES, ratio)
    L = loop_gain(LINES, 0.26) * np.exp(-0.5j * 2.0 * np.pi * LINES * DT)
    assert found.sensitivity_peak == pytest.approx(np.max(1.0 / np.abs(1.0 + L)))
    # |L| = 1 at 2 sin(w / 2) = 0.26; its phase is -(pi + w) / 2 - 2.5 w.
    crossing = 2.0 * np.arcsin(0.13)
    margin = np.pi / 2.0 - crossing / 2.0 - 2.5 * crossing
    assert found.phase_margin_deg == pytest.approx(np.degrees(margin), rel=1e-3)
    assert found.delay_margin_samples == pytest.approx(margin / crossing, rel=1e-3)
    # The phase is -180 degrees at 3 w = pi / 2.
    gain = 2.0 * np.sin(np.pi / 12.0) / 0.26
    assert found.gain_margin_dB == pytest.approx(20.0 * np.log10(gain), rel=1e-3)


@pytest.mark.parametrize("gain", [0.5, 1.3, 2.0])
def test_the_disk_margin_is_that_of_python_control(gain):
    stage = control.tf(0.2 * gain, [1.0, -1.0, 0.0, 0.0], DT)
    expected, *_ = control.disk_margins(stage, 2.0 * np.pi * LINES)
    found = measured_margins(LOOP, LINES, np.full(LINES.size, gain, complex))
    assert found.disk_margin == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("gain", "stable"), [(2.8, True), (3.4, False)])
def test_an_unstable_measured_loop_is_seen(gain, stable):
    """0.2 / (z - 1) with two delays is stable up to a gain of 0.618."""
    found = measured_margins(LOOP, LINES[::40], np.full(100, gain, complex))
    poles = np.linalg.eigvals(A - gain * 0.2 * np.outer([0.0, 1.0, 0.0], [1, 0, 0]))
    assert bool(np.abs(poles).max() < 1.0) is stable
    assert found.stable is stable
    # A resonance that the model lacks, whose circle goes around -1.
    w = LINES / 30.0
    ringing = 1.0 + gain * w**2 / (1.0 - w**2 + 0.01j * w)
    assert not measured_margins(LOOP, LINES, ringing).stable


def test_lines_above_half_the_rate_do_not_count():
    frequency = np.array([10.0, 20.0, 30.0, 600.0])
    found = measured_margins(LOOP, frequency, np.array([1.0, 1.0, 1.0, 1e9], complex))
    assert (found.lines, found.highest_Hz) == (3, 30.0)
    assert found.gain_margin_dB is None  # no crossing within the lines
    with pytest.raises(ValueError, match="1 measured lines lie below half the rate"):
        measured_margins(LOOP, frequency[2:], np.ones(2, complex))


def measured(**changed):
    figures = {
        "lines": 9,
        "lowest_Hz": 1.0,
        "highest_Hz": 99.0,
        "stable": True,
        "sensitivity_peak": 1.5,
        "sensitivity_peak_Hz": 40.0,
        "gain_margin_dB": 9.0,
        "phase_margin_deg": 60.0,
        "delay_margin_samples": 2.0,
        "disk_margin": 0.9,
    }
    return {"after": MeasuredMargins(**figures | changed)}


LIMITS = {
    "sensitivity_peak": 2.0,
    "delay_margin": 1.0,
    "gain_margin": 6.0,
    "disk_margin": 0.7,
}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({}, None),
        ({"sensitivity_peak": 2.09}, None),
        ({"gain_margin_dB": None}, None),
        ({"phase_margin_deg": 1.0}, None),  # not limited
        ({"stable": False}, "on the measured response the tuned loop is unstable"),
        (
            {"sensitivity_peak": 2.2},
            r"Ms is 2.2 at 40 Hz \(limit 2; 1.\d+ on the model\): tighten const",
        ),
        ({"delay_margin_samples": 0.9}, "the delay margin is 0.9 samples"),
        ({"disk_margin": 0.68}, None),
        ({"disk_margin": None}, None),
        ({"disk_margin": 0.5}, r"the disk margin is 0.5 \(limit 0.7; 0.\d+ on the"),
        ({"gain_margin_dB": 5.0}, r"the gain margin is 5 dB \(limit 6; \d"),
    ],
)
def test_an_alarm_says_what_the_response_violates(changed, message):
    reports = StabilityReports({"after": {"ascending": report_of(LOOP)}})
    alarms = list(response_alarms(measured(**changed), LIMITS, reports))
    if message is None:
        assert alarms == []
        return
    assert len(alarms) == 1
    assert re.search(message, alarms[0]), alarms
    # Limits that the model violates too have an alarm of their own.
    tight = {name: 1.01 if "peak" in name else 90.0 for name in LIMITS}
    again = list(response_alarms(measured(**changed), tight, reports))
    assert again == (alarms if "stable" in changed else [])


def test_a_loop_without_a_measured_response_has_no_alarm():
    assert list(response_alarms({}, LIMITS, StabilityReports())) == []
