"""Figures of the voltage at the piezo: closed forms, and a study with an amplifier."""

import json

import numpy as np
import pytest
from scipy import signal

import piezojax as pj
from piezojax.report.drive_table import drive_table
from piezojax.report.tuning_pictures import write_numbers
from piezojax.study import Study, build
from piezojax.tuning.drive import Drive, drive_of
from piezojax.tuning.result import load_result

DT = 1e-4
TIME = DT * np.arange(20_000)
CAPACITANCE = 2e-6


def test_figures_of_a_sine():
    """The sine has the amplitude a and angular frequency w; the constant has noise."""
    a, w = 30.0, 2.0 * np.pi * 40.0
    held = 50.0 + 0.02 * np.random.default_rng(0).standard_normal(TIME.size)
    slow = 0.5 * a * np.sin(w * TIME)
    found = drive_of([slow, a * np.sin(w * TIME)], held, DT, 5000, CAPACITANCE)
    slew = a * w * np.sinc(0.5 * w * DT / np.pi) / np.sqrt(2.0)
    assert found.noise_rms_V == pytest.approx(0.02, rel=0.02)
    assert found.high_frequency_rms_V == pytest.approx(0.0, abs=1e-6)
    assert found.slew_rms_V_per_s == pytest.approx(slew, rel=1e-4)
    assert found.current_rms_A == pytest.approx(CAPACITANCE * slew, rel=1e-4)
    peak = CAPACITANCE * a * w
    assert found.current_peak_A == pytest.approx(peak, rel=1e-3)
    # |u i| = C w a^2 |sin cos| has the mean C w a^2 / pi.
    assert found.power_W == pytest.approx(peak * a / np.pi, rel=1e-3)


@pytest.mark.parametrize(("frequency", "inside"), [(900.0, 0.0), (1100.0, 1.0)])
def test_only_frequencies_above_a_tenth_of_the_rate_are_high(frequency, inside):
    run = 40.0 * TIME + 0.3 * np.sin(2.0 * np.pi * frequency * TIME)
    found = drive_of([run], run, DT, 0, None).high_frequency_rms_V
    assert found == pytest.approx(inside * 0.3 / np.sqrt(2.0), abs=1e-4)


def test_unknown_figures_are_none():
    run = np.sin(TIME)
    bare = drive_of([run], run, DT, 0, None)
    assert (bare.current_rms_A, bare.current_peak_A, bare.power_W) == (None,) * 3
    lost = np.where(TIME > 1.0, np.nan, run)
    assert set(drive_of([run, lost], lost, DT, 0, 1e-6).model_dump().values()) == {None}


STUDY = {
    "title": "an integral controller behind an amplifier",
    "rate": 2e4,
    "seed": 5,
    "plant": {"type": "Affine", "gain": 0.5},
    "actuator": {
        "lower": -20.0,
        "upper": 120.0,
        "bandwidth": 800.0,
        "capacitance": 3e-6,
    },
    "sensor": {"noise_rms": 0.02},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 300.0, "dt": 5e-5},
    "references": {
        "tune": ["SIN50"],
        "unseen": ["SW50"],
        "duration": 0.1,
        "settle": 0.02,
    },
    "parameters": {"controller.integral": {"lower": 100.0, "upper": 900.0}},
    "optimiser": {"method": "bfgs", "starts": 1, "candidates": 2, "steps": 2},
}


@pytest.fixture(scope="module")
def outcome():
    return pj.tune(build(Study.model_validate(STUDY), "small.toml"))


def at_piezo(voltage):
    """Return the voltage behind the low-pass of 800 Hz, by SciPy."""
    low_pass = signal.cont2discrete(
        signal.butter(1, 1600.0 * np.pi, analog=True), 5e-5, "foh"
    )
    numerator, denominator = low_pass[0].ravel(), low_pass[1]
    rest = signal.lfilter_zi(numerator, denominator) * voltage[0]
    return signal.lfilter(numerator, denominator, voltage, zi=rest)[0]


def test_the_figures_are_of_the_hold_out_behind_the_amplifier(outcome):
    runs = [at_piezo(log[1].voltage) for log in outcome.logs([0, 1]).values()]
    slews = [np.diff(run)[400:] * 2e4 for run in runs]
    found = outcome.drive[1]["piezo"]
    expected = max(np.sqrt(np.mean(slew**2)) for slew in slews)
    assert found.slew_rms_V_per_s == pytest.approx(expected, rel=1e-9)
    assert found.current_rms_A == pytest.approx(3e-6 * expected, rel=1e-9)
    highest = max(np.abs(slew).max() for slew in slews)
    assert found.slew_peak_V_per_s == pytest.approx(highest, rel=1e-9)


def test_the_noise_equals_the_closed_form(outcome):
    """Integral control of a static plant: noise passes the loop and the low-pass."""
    gain = outcome.result.gains["controller.integral"] * 5e-5
    pole = np.exp(-1600.0 * np.pi * 5e-5)
    # u = -I/(1 - z^-1) (F u 0.5 z^-1 + n), F the low-pass of the first order
    step = 1.0 - (1.0 - pole) / (1600.0 * np.pi * 5e-5)
    b = np.array([step, 1.0 - pole - step])
    a = np.array([1.0, -pole])
    denominator = np.polyadd(
        np.append(np.polymul([1.0, -1.0], a), 0.0)[:3],
        0.5 * gain * np.concatenate([[0.0], b]),
    )
    held = signal.lfilter(gain * b, denominator, np.eye(1, 4000)[0])
    expected = 0.02 * np.sqrt(np.sum(held**2))
    # one draw of 1600 samples
    assert outcome.drive[1]["piezo"].noise_rms_V == pytest.approx(expected, rel=0.2)
    assert outcome.drive[1]["piezo"].noise_rms_V > 0.0


def test_the_figures_are_in_the_file_and_in_the_table(outcome, tmp_path):
    write_numbers(outcome, tmp_path)
    written = load_result(tmp_path)
    assert (written.drive_before, written.drive) == outcome.drive
    plain = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert set(plain["drive"]["piezo"]) == set(Drive.model_fields)
    table = drive_table(outcome.drive, 2e4, has_capacitance=True)
    titles = list(table.columns[0].cells)
    assert titles[1] == "above 2000 Hz, rms"
    assert len(titles) == 7
    assert table.caption is None
    noise = outcome.drive[1]["piezo"].noise_rms_V
    assert next(iter(table.columns[2].cells)) == f"{noise:.3g}"


def test_figures_that_need_a_capacitance_are_omitted_without_one():
    drive = Drive(noise_rms_V=0.1, high_frequency_rms_V=None, slew_rms_V_per_s=2.0)
    both = {"x": drive, "y": drive}
    table = drive_table((both, both), 1e4, has_capacitance=False)
    assert list(table.columns[0].cells)[::4] == [
        "x, noise on a constant reference, rms",
        "y, noise on a constant reference, rms",
    ]
    shown = list(table.columns[1].cells)[:4]
    assert shown == ["0.1", "diverges", "2", "diverges"]
    assert "V stands for the unit of the command" in str(table.caption)


def test_currents_of_diverged_loops_are_in_the_table():
    lost = {
        "piezo": Drive(
            noise_rms_V=None, high_frequency_rms_V=None, slew_rms_V_per_s=None
        )
    }
    table = drive_table((lost, lost), 1e4, has_capacitance=True)
    assert list(table.columns[2].cells) == ["diverges"] * 7
