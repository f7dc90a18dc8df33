"""Modes, lag and delay from noisy frequency responses of simulated stages."""

import json
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from click.testing import CliRunner
from oracles import modal_responses

import piezojax as pj
from piezojax.cli.identify import main
from piezojax.core.serial import read_about
from piezojax.dynamics import linearise
from piezojax.identification.estimators import line_noise, modal_model
from piezojax.identification.estimators.line_noise import noise_deviation
from piezojax.identification.estimators.modal_fit import modal_fit
from piezojax.identification.records.response import FrequencyResponse
from piezojax.identification.records.response_file import (
    read_response,
)
from piezojax.identification.response_model import identify_response

LINES = np.linspace(20.0, 5000.0, 250)
RATE = 20_000.0


@cache
def measured(seed):
    stage = modal_responses.stage(seed)
    return stage, modal_responses.measured(stage, LINES, seed)


@cache
def model_of(seed):
    return identify_response(FrequencyResponse(LINES, measured(seed)[1]), RATE, most=4)


@pytest.mark.parametrize("seed", [1000, 1001, 1002])
def test_the_modes_of_a_stage_are_found(seed):
    stage, fit = measured(seed)[0], model_of(seed).fit
    assert len(fit.frequency) == len(stage.frequency)
    for true, damping, gain in zip(
        stage.frequency, stage.damping, stage.gain, strict=True
    ):
        i = int(np.argmin([abs(one.value - true) for one in fit.frequency]))
        assert fit.frequency[i].value == pytest.approx(true, rel=2e-3)
        assert fit.damping[i].value == pytest.approx(damping, rel=0.1)
        assert fit.gain[i].value == pytest.approx(gain, rel=0.1)
        assert abs(fit.frequency[i].value - true) < 4.0 * fit.frequency[i].error
        assert abs(fit.damping[i].value - damping) < 4.0 * fit.damping[i].error
    assert fit.delay.value == pytest.approx(stage.delay, abs=4.0 * fit.delay.error)
    exact = modal_responses.response(stage, LINES)
    assert np.median(np.abs(fit.fitted / exact - 1.0)) < 0.01


def test_the_noise_is_estimated_without_a_model():
    stage, values = measured(1001)
    exact = np.abs(modal_responses.response(stage, LINES))
    expected = np.hypot(stage.noise[0] * exact, stage.noise[1])
    ratio = noise_deviation(FrequencyResponse(LINES, values)) / expected
    assert 0.8 < np.median(ratio) < 1.25


def test_a_lag_is_distinguished_from_a_mode():
    stage = modal_responses.stage(1000)
    s = 2j * np.pi * LINES
    values = modal_responses.measured(stage, LINES, 3) / (1.0 + 2e-4 * s)
    fit = modal_fit(FrequencyResponse(LINES, values), most=2)
    assert fit.lag is not None
    assert fit.lag.value == pytest.approx(2e-4, rel=0.02)
    assert len(fit.frequency) == len(stage.frequency)


def test_the_system_has_the_response_of_the_stage():
    """An analyser measures the response; the loop holds its input for a sample."""
    stage, found = measured(1001)[0], model_of(1001)
    assert isinstance(found.system.parts[1], pj.dynamics.Modes)
    low = LINES[LINES < 1500.0]
    model = linearise(found.system, 0.0, found.system.init(0.0), 1.0 / RATE)
    z = np.exp(2j * np.pi * low / RATE)
    A, B, C, D = (np.asarray(part) for part in (model.A, model.B, model.C, model.D))
    ours = np.array(
        [(C @ np.linalg.solve(x * np.eye(len(A)) - A, B) + D)[0, 0] for x in z]
    )
    # The output of a step is that at its end, one sample before a measurement.
    turn = np.pi * low / RATE
    hold = np.sinc(turn / np.pi) * np.exp(-1j * turn)
    exact = modal_responses.response(stage, low) * hold * z
    np.testing.assert_allclose(ours, exact, rtol=0.05, atol=2e-3 * abs(exact[0]))


def test_the_hold_is_removed_from_held_responses_and_the_delay_is_not():
    stage, values = measured(1000)
    turn = np.pi * LINES / RATE
    hold = np.sinc(turn / np.pi) * np.exp(-1j * turn)
    found = identify_response(
        FrequencyResponse(LINES, values * hold), RATE, held=True, most=2
    )
    delay = found.report.parameters["delay.delay"]
    assert delay.value == pytest.approx(stage.delay, abs=4.0 * delay.standard_error)


def test_the_bound_contains_the_true_error():
    stage, found = measured(1002)[0], model_of(1002)
    exact = modal_responses.response(stage, LINES)
    error = np.abs(exact / found.fit.fitted - 1.0)
    bound = found.about.error_bound.at(LINES)
    assert np.mean(error <= bound) > 0.97
    assert found.about.error_bound.at(9000.0) == 25.0
    assert not found.about.error_bound.excited_at(9000.0)


HEADS = {
    "frequency_Hz,magnitude_dB,phase_deg": lambda f, g: (
        *(f, 20.0 * np.log10(np.abs(g))),
        np.degrees(np.angle(g)),
    ),
    "freq (kHz),gain,phase (rad)": lambda f, g: (f / 1e3, np.abs(g), np.angle(g)),
    "f,coherence (ratio),magdB,Phase (deg),T_degC": lambda f, g: (
        *(f, np.ones(f.size), 20.0 * np.log10(np.abs(g))),
        *(np.degrees(np.angle(g)), np.full(f.size, 21.0)),
    ),
    "omega [rad/s],real,imag": lambda f, g: (2.0 * np.pi * f, g.real, g.imag),
}


@pytest.mark.parametrize("head", HEADS)
def test_files_of_analysers(tmp_path, head):
    _, values = measured(1000)
    table = np.column_stack(HEADS[head](LINES, values))[::-1]
    np.savetxt(tmp_path / "r.csv", table, "%.12g", ",", header=head, comments="")
    found = read_response(tmp_path / "r.csv", unit="nm/V")
    np.testing.assert_allclose(found.frequency, LINES, rtol=1e-9)
    np.testing.assert_allclose(found.values, values, rtol=1e-9)
    assert found.unit == "nm/V"


@pytest.mark.parametrize(
    ("head", "rows", "message"),
    [
        ("x,magnitude_dB,phase_deg", 20, "no column is a frequency; name one freq"),
        ("frequency_Hz,a,b", 20, "name the columns of the response magnitude_dB or"),
        ("frequency_Hz,gain,phase", 20, "unit of column 'phase' is not known; name it"),
        ("frequency_Hz,gain,phase_deg", 5, "the response has 5 lines; at least 8"),
        ("f,gain_1,gain_2,phase_deg", 20, "'gain_1' and 'gain_2' are both a magnitude"),
    ],
)
def test_bad_files_are_refused(tmp_path, head, rows, message):
    columns = [1.0 + np.arange(rows), *np.ones((head.count(","), rows))]
    table = np.column_stack(columns)
    np.savetxt(tmp_path / "r.csv", table, "%g", ",", header=head, comments="")
    with pytest.raises(ValueError, match=message):
        read_response(tmp_path / "r.csv")


@pytest.mark.parametrize(
    ("frequency", "values", "message"),
    [
        (np.arange(9.0), np.ones(9), "must be above 0 and increase from line to line"),
        (np.ones(9), np.ones(9), "must be above 0 and increase"),
        (1.0 + np.arange(9), np.ones(8), r"shape \(9,\), the response \(8,\)"),
        (1.0 + np.arange(9), np.full(9, np.nan), "line 0 is not a finite number"),
    ],
)
def test_bad_responses_are_refused(frequency, values, message):
    with pytest.raises(ValueError, match=message):
        FrequencyResponse(frequency, values)


def test_a_rate_too_low_for_a_mode_is_refused():
    _, values = measured(1000)
    response = FrequencyResponse(LINES, values)
    highest = max(modal_responses.stage(1000).frequency)
    with pytest.raises(ValueError, match=r"cannot be simulated at .* higher rate"):
        identify_response(response, 2.1 * highest, most=1)
    with pytest.raises(ValueError, match="rate is 0 Hz; it must be above 0"):
        identify_response(response, 0.0)


def test_the_command_writes_a_model_that_a_study_reads(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stage, values = measured(1000)
    table = np.column_stack([LINES, np.abs(values), np.degrees(np.angle(values))])
    head = "frequency_Hz,magnitude,phase_deg"
    np.savetxt("bench.csv", table, "%.9g", ",", header=head, comments="")
    line = "bench.csv --response --rate 20000 --out found"
    done = CliRunner().invoke(main, line.split())
    assert done.exit_code == 0, done.output
    assert "note: a frequency response shows small motions" in done.output
    report = json.loads((tmp_path / "found" / "response.json").read_text())
    first = report["parameters"]["dynamics.frequency.0"]
    assert min(abs(stage.frequency / first["value"] - 1.0)) < 2e-3
    assert (tmp_path / "found" / "response.png").stat().st_size > 10_000
    about = read_about(tmp_path / "found" / "model.json")
    assert about.units == {"input": "V", "output": "um"}
    plant = pj.load(tmp_path / "found" / "model.json")
    _, output = pj.simulate(plant, jnp.ones(20_000), plant.init(0.0))
    assert float(output[-1]) == pytest.approx(sum(stage.gain), rel=0.02)
    refused = CliRunner().invoke(main, ["bench.csv", "--response"])
    assert refused.exit_code == 1
    assert "a file of --response needs a --rate" in refused.output


def test_a_magnitude_in_decibels_needs_its_unit(tmp_path):
    table = np.column_stack([LINES, np.full(LINES.size, -20.0), np.zeros(LINES.size)])
    head = "f,gain,phase_deg"
    np.savetxt(tmp_path / "r.csv", table, "%g", ",", header=head, comments="")
    with pytest.raises(ValueError, match="column 'gain' is below 0; name it gain_dB"):
        read_response(tmp_path / "r.csv")


def test_few_lines_without_noise_are_fitted_by_few_modes():
    stage = modal_responses.stage(1000)
    few = np.linspace(0.5, 1.5, 12) * stage.frequency[0]
    exact = modal_responses.response(stage, few)
    for values in (exact, modal_responses.measured(stage, few, 5)):
        fit = modal_fit(FrequencyResponse(few, values))
        assert len(fit.frequency) == 1
        assert fit.frequency[0].value == pytest.approx(stage.frequency[0], rel=0.01)


def test_a_dead_channel_and_a_delay_of_many_samples():
    with pytest.raises(ValueError, match="the response is 0 at every line"):
        modal_fit(FrequencyResponse(LINES, np.zeros(LINES.size)))
    stage, values = measured(1000)
    found = identify_response(FrequencyResponse(LINES, values), 1e6, most=1)
    assert stage.delay * 1e6 > 64
    whole, rest = found.system.parts[2:]
    delay = found.fit.delay.value
    assert whole.samples * 1e-6 + float(rest.delay) == pytest.approx(delay, rel=1e-9)


def test_the_model_of_a_held_input_is_that_of_the_sampled_stage():
    """Against SciPy's discretisation; the delay is a whole number of samples."""
    dt, w, zeta = 1e-4, 2.0 * np.pi * 900.0, 0.03
    lines = np.linspace(100.0, 4000.0, 60)
    none = np.zeros(lines.size)
    point = np.r_[np.log(w), np.log(zeta), 0.7, 2 * dt * 2.0 * np.pi * lines[-1]]
    found = modal_model.response(
        point,
        modal_model.Shape(1, False, True),
        modal_model.lines_of(lines, none, none, dt),
    )[0]
    b, a, _ = scipy.signal.cont2discrete(([0.7 * w**2], [1.0, 2 * zeta * w, w**2]), dt)
    turn = 2.0 * np.pi * lines * dt
    exact = scipy.signal.freqz(b.ravel(), a, turn)[1] * np.exp(-2j * turn)
    np.testing.assert_allclose(found, exact, rtol=2e-3)


@pytest.mark.parametrize("held", [None, 1e-4])
def test_derivatives_of_the_model(held):
    lines = np.linspace(100.0, 4000.0, 30)
    none, shape = np.zeros(lines.size), modal_model.Shape(2, True, True)
    data = modal_model.lines_of(lines, none, none, held)
    logs = np.log([5e3, 1.2e4, 0.02, 0.1])
    point = np.r_[logs, 1.0, 0.3, np.log(1e-5), 2.0]
    slopes = modal_model.response(point, shape, data)[1]
    for i in range(point.size):
        step = 1e-6 * np.eye(point.size)[i]
        ends = [modal_model.response(point + s * step, shape, data)[0] for s in (1, -1)]
        change = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(slopes[:, i], change, rtol=1e-5, atol=1e-7)


def test_gain_and_shares_have_the_errors_of_all_parameters():
    """Monte Carlo of the linear estimate at the truth, for two near modes."""
    lines = np.linspace(100.0, 1200.0, 80)
    shape = modal_model.Shape(2, False, True)
    point = np.r_[np.log(2 * np.pi * np.array([500.0, 560.0])), np.log([0.05, 0.05])]
    point = np.r_[point, 0.6, 0.5, 1.0]
    deviation = np.full(lines.size, 0.01)
    data = modal_model.lines_of(lines, np.zeros(lines.size), deviation, None)
    fit = modal_model.fit_of(
        point, shape, data, scale=1.0, excess=None, searched=80, held=None
    )
    rows = modal_model.residuals(point, shape, data)[1]
    noise = np.random.default_rng(2).standard_normal((rows.shape[0], 4000))
    gains = point[4:6, None] + (np.linalg.pinv(rows) @ noise)[4:6]
    total = gains.sum(axis=0)
    assert fit.static_gain.error == pytest.approx(np.std(total), rel=0.05)
    assert fit.share[0].error == pytest.approx(np.std(gains[1] / total), rel=0.1)
    apart = np.hypot(*(one.error for one in fit.gain))
    assert fit.static_gain.error < 0.3 * apart  # neglecting the correlation


def test_many_lines_are_merged_without_loss():
    lines = np.linspace(1.0, 5000.0, 20_000)
    random, deviation = np.random.default_rng(4), 0.1 + lines / 5e4
    noise = random.standard_normal((2, lines.size)) * deviation
    found = line_noise.merged(lines, 1.0 + noise[0] + 1j * noise[1], deviation)
    frequency, values, spread = found
    assert frequency.size < 2500
    assert np.sum(spread**-2.0) == pytest.approx(np.sum(deviation**-2.0))
    assert np.std((values - 1.0).real / spread) == pytest.approx(1.0, abs=0.05)
    assert np.all(np.diff(frequency) > 0.0)
    few = line_noise.merged(lines[:1000], noise[0, :1000], deviation[:1000])
    np.testing.assert_array_equal(few[0], lines[:1000])


def test_known_variances_are_the_weights():
    stage, values = measured(1000)
    exact = modal_responses.response(stage, LINES)
    variance = np.hypot(stage.noise[0] * np.abs(exact), stage.noise[1]) ** 2
    random = np.random.default_rng(8)
    for freedom in (2.0, 8.0):
        drawn = variance * random.chisquare(freedom, LINES.size) / freedom
        known = FrequencyResponse(LINES, values, variance=drawn, freedom=freedom)
        ratio = noise_deviation(known) / np.sqrt(variance)
        assert 0.9 < np.median(ratio) < 1.1
        assert np.std(ratio) < 0.2
    wrong = FrequencyResponse(LINES, values, variance=0.04 * variance)
    found = identify_response(wrong, RATE, most=1)
    assert found.fit.excess == pytest.approx(25.0, rel=0.25)
    assert "times as large as the variance of the response" in found.report.notes[1]
    ratio = found.fit.deviation / np.sqrt(0.5 * variance)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)


def test_a_floor_below_the_noise_in_proportion_is_found():
    """Few lines on a mode whose response falls far below the noise of its sensor."""
    frequency = np.geomspace(2.0, 4000.0, 100)
    s = frequency / 300.0
    gain = 0.2 / (1.0 - s**2 + 0.06j * s) / (1.0 + 2.0j * s)
    relative, floor = 0.01, 2e-4
    random = np.random.default_rng(7)
    noise = random.standard_normal((2, 100)) * np.sqrt(0.5)
    expected = np.hypot(relative * np.abs(gain), floor)
    values = gain + expected * (noise[0] + 1j * noise[1])
    found = noise_deviation(FrequencyResponse(frequency, values))
    for part in (frequency < 100.0, frequency > 1500.0):
        ratio = np.median(found[part] / expected[part])
        assert ratio == pytest.approx(1.0, rel=0.4)


def test_converters_show_no_mode_above_the_folding_frequency():
    """Such a mode could not be simulated, and its image looks the same."""
    frequency, sample = np.geomspace(2.0, 4500.0, 60), 1e-4
    values = 0.1 / (1.0 + 2e-3j * np.pi * frequency)
    for held, highest in ((sample, 0.9 * 0.5 / sample), (None, 1.2 * 4500.0)):
        data = modal_model.lines_of(frequency, values, np.abs(values), held)
        _, upper = modal_model.bounds(modal_model.Shape(1, False, False), data)
        assert np.exp(upper[0]) == pytest.approx(2.0 * np.pi * highest)
