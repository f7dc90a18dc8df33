"""Residual analysis on stages simulated in NumPy: alarms, bound, statistics."""

from typing import Any

import numpy as np
import pytest
import scipy.signal
import scipy.stats

from piezojax import Record, identify, save
from piezojax.core.error_bound import UNSEEN, ErrorBound
from piezojax.core.serial import read_about
from piezojax.identification import FitReport
from piezojax.identification.plausibility import plausibility_warnings
from piezojax.identification.records.record import rises_evenly
from piezojax.identification.residuals.bound import (
    ABSORBED,
    RelativeError,
    deviations,
    error_bound,
    joined,
    relative_error,
)
from piezojax.identification.residuals.correlation import (
    autocorrelation,
    cross_correlation,
)
from piezojax.identification.residuals.coverage import unseen_in
from piezojax.identification.residuals.peaks import unmodelled_peaks
from piezojax.identification.residuals.report import model_faults, residual_report

RATE = 10e3
DT = 1.0 / RATE
SAMPLES = 16384
HALVES = slice(0, SAMPLES // 2), slice(SAMPLES // 2, SAMPLES)
WHOLE = slice(0, SAMPLES)
GAIN = 0.12  # um/V
NOISE = 0.002  # um


def discrete(numerator, denominator):
    held: Any = scipy.signal.cont2discrete((numerator, denominator), DT, "zoh")
    return np.ravel(held[0]), held[1]


def lag(seconds):
    return [1.0], [seconds, 1.0]


def mode(frequency, damping):
    w = 2.0 * np.pi * frequency
    return [w**2], [1.0, 2.0 * damping * w, w**2]


def product(*parts):
    top, bottom = np.ones(1), np.ones(1)
    for b, a in parts:
        top, bottom = np.polymul(top, b), np.polymul(bottom, a)
    return discrete(GAIN * top, bottom)


SLOW = product(lag(1e-3))
STAGE = product(lag(1e-3), mode(780.0, 0.02))


def excitation(seed=0, top=4000.0, samples=SAMPLES):
    """Return two slow sines plus noise up to ``top`` Hz."""
    draw = np.random.default_rng(seed).standard_normal(samples)
    if top < 0.5 * RATE:
        band = scipy.signal.cheby2(12, 80.0, 1.15 * top, fs=RATE, output="sos")
        draw = np.asarray(scipy.signal.sosfilt(band, draw))
    time = np.arange(samples) * DT
    slow = np.sin(2 * np.pi * 7.0 * time) + np.sin(2 * np.pi * 19.0 * time)
    return 40.0 + 10.0 * slow + 5.0 * draw / draw.std()


def answer(stage, input):
    """Return the output from rest at the first input."""
    b, a = stage
    state = scipy.signal.lfilter_zi(b, a) * input[0]
    return scipy.signal.lfilter(b, a, input, zi=state)[0]


def noisy(output, seed=0):
    draw = np.random.default_rng([1, seed]).standard_normal(output.size)
    return output + NOISE * draw


def analysed(input, output, run, **more):
    record = Record(input, output, DT, source="made up", **more)
    report, alarms, warnings = residual_report([record], [run[:, None]], *HALVES)
    return report, [*alarms, *warnings]


INPUT = excitation()
OUTPUT = noisy(answer(STAGE, INPUT))


# Alarms of the residual


@pytest.mark.parametrize("seed", range(10))
def test_a_right_model_gives_no_alarm(seed):
    input = excitation(seed)
    run = answer(STAGE, input)
    report, warnings = analysed(input, noisy(run, seed), run)
    assert warnings == []
    assert report.peaks == []
    assert not report.whiteness[0].significant


@pytest.mark.parametrize("seed", range(3))
def test_a_missing_mode_is_named_by_frequency_and_size(seed):
    input = excitation(seed)
    output = noisy(answer(STAGE, input), seed)
    report, warnings = analysed(input, output, answer(SLOW, input))
    (peak,) = report.peaks
    assert peak.frequency_Hz == pytest.approx(780.0, rel=0.02)
    # |1 / (2 zeta j) - 1| = 25, reduced because lines of 10 Hz miss a peak of 30 Hz.
    assert 15.0 < peak.times_gain < 27.0
    assert report.whiteness[0].significant
    assert report.input_correlation[0].significant
    (warning,) = warnings
    assert "leaves a peak at 7" in warning
    assert "fit a model with a mode" in warning


def between_lines(peak, level=1.0, noise=30.0, seed=0):
    """Return the errors of a model whose multisine has every tenth line.

    The error is ``level``, and ``peak`` more at 1000 Hz. The other lines are noise.
    """
    frequency = np.arange(100.0, 4000.0, 5.0)
    excited = np.arange(frequency.size) % 10 == 0
    margin = np.where(excited, 0.3, noise)
    draw = np.random.default_rng(seed).standard_normal((2, frequency.size)) / 2.3
    true = level + peak / np.abs(1.0 - (frequency / 1000.0) ** 2 + 0.02j) / 50.0
    error = np.abs(np.where(excited, true, 0.0) + margin * (draw[0] + 1j * draw[1]))
    gain = np.full(frequency.size, 0.01)
    return RelativeError(frequency, error, margin, gain, 5.0, averages=15.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_peak_is_found_between_lines_of_noise(seed):
    peaks = unmodelled_peaks(between_lines(20.0, seed=seed))
    assert peaks[0].frequency_Hz == pytest.approx(1000.0, abs=1.0)
    assert peaks[0].times_gain == pytest.approx(21.0, rel=0.05)
    assert len(peaks) == 1


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("level", [0.1, 3.0])
def test_lines_of_noise_are_no_peak(level, seed):
    assert unmodelled_peaks(between_lines(0.0, level, seed=seed)) == []


def test_a_mode_at_the_wrong_frequency_is_named():
    run = answer(product(lag(1e-3), mode(650.0, 0.02)), INPUT)
    report, _ = analysed(INPUT, OUTPUT, run)
    assert report.peaks[0].frequency_Hz == pytest.approx(780.0, rel=0.02)


def test_wrong_dynamics_without_a_peak_are_named():
    run = answer(product(lag(1e-2)), INPUT)
    output = noisy(answer(product(lag(1e-3)), INPUT))
    _, warnings = analysed(INPUT, output, run)
    assert any("its dynamics are too simple" in text for text in warnings)


@pytest.mark.parametrize("factor", [0.5, 2.0, 1000.0])
def test_the_model_of_another_stage_is_named(factor):
    _, warnings = analysed(INPUT, factor * OUTPUT, answer(STAGE, INPUT))
    assert any("is that of another stage or unit" in text for text in warnings)


def test_frequencies_of_the_validation_part_alone_are_named():
    input = np.concatenate([excitation(1, 200.0), excitation(2, 1500.0)])[
        SAMPLES // 2 : 3 * SAMPLES // 2
    ]
    report, warnings = analysed(input, answer(STAGE, input), answer(STAGE, input))
    assert report.unseen.band_Hz is not None
    low, high = report.unseen.band_Hz
    assert 200.0 < low < 400.0
    assert 1300.0 < high < 2000.0
    assert any("frequencies from" in text and "--train" in text for text in warnings)


def test_amplitudes_of_the_validation_part_alone_are_named():
    input = INPUT.copy()
    input[HALVES[1]] = 40.0 + 2.0 * (input[HALVES[1]] - 40.0)
    report, warnings = analysed(input, answer(STAGE, input), answer(STAGE, input))
    assert report.unseen.input_range == (
        input[HALVES[1]].min(),
        input[HALVES[1]].max(),
    )
    assert any("beyond that of the training part" in text for text in warnings)


def test_every_input_and_every_record_counts_in_the_coverage():
    wide = INPUT.copy()
    wide[HALVES[1]] = 40.0 + 2.0 * (wide[HALVES[1]] - 40.0)
    new = np.concatenate([excitation(1, 200.0), excitation(2, 1500.0)])
    new = new[SAMPLES // 2 : 3 * SAMPLES // 2]
    inputs = [np.stack([INPUT, other], axis=1) for other in (wide, new)]
    run = answer(STAGE, INPUT)[:, None]
    records = [Record(x, run, DT, input_units=("V", "N")) for x in inputs]
    found, _, warnings = residual_report([records[0]], [run], *HALVES)
    assert found.unseen.input == 1
    assert any("part's input 1 goes from" in t and " N, beyond" in t for t in warnings)
    narrow = Record(excitation(3, 200.0), run, DT)
    second = Record(new, run, DT)
    assert unseen_in([narrow, second], *HALVES).band_Hz is not None
    # Training covers what it holds in any record.
    trained = Record(INPUT, run, DT)
    assert unseen_in([second, trained], *HALVES).band_Hz is None


def test_a_peak_is_found_in_any_record():
    slow, fast = excitation(1, 100.0), excitation(2)
    records = [Record(x, noisy(answer(STAGE, x)), DT) for x in (slow, fast)]
    runs = [answer(SLOW, x)[:, None] for x in (slow, fast)]
    (alone,) = model_faults(records[1:], runs[1:], HALVES[1]).peaks
    (peak,) = model_faults(records, runs, HALVES[1]).peaks
    assert peak == alone
    short = records[0].until(SAMPLES // 2)  # without a validation part
    runs = [runs[1], runs[0][: short.samples]]
    assert model_faults([records[1], short], runs, HALVES[1]).peaks == [alone]


def test_a_narrow_record_has_an_alarm_with_its_band():
    input = excitation(top=100.0)
    report, warnings = analysed(
        input, noisy(answer(STAGE, input)), answer(STAGE, input)
    )
    assert report.coverage.band_Hz is not None
    assert 80.0 < report.coverage.band_Hz[1] < 300.0
    assert report.coverage.input_range == (input.min(), input.max())
    assert any("excites nothing above" in text for text in warnings)


def test_records_of_several_channels_have_no_bound():
    inputs = np.stack([excitation(1), excitation(2)], axis=1)
    run = answer(STAGE, inputs[:, 0])[:, None]
    record = Record(inputs, noisy(run[:, 0]), DT)
    report, *_ = residual_report([record], [run], *HALVES)
    assert report.error_bound is None
    assert len(report.input_correlation) == 2


# The bound


def true_error(stage, model, frequency):
    each = [scipy.signal.freqz(*s, worN=frequency, fs=RATE)[1] for s in (stage, model)]
    return np.abs(each[0] / each[1] - 1.0)


@pytest.mark.parametrize("seed", range(3))
def test_the_bound_contains_the_true_error(seed):
    model = product(lag(1.2e-3), mode(760.0, 0.03))
    input = excitation(seed)
    record = Record(input, noisy(answer(STAGE, input), seed), DT)
    run = answer(model, input)
    found = relative_error(record, run, WHOLE)
    clear = (found.frequency < 3500.0) & (found.margin < 1.0)
    ratio = (found.upper / true_error(STAGE, model, found.frequency))[clear]
    assert clear.sum() > 400
    # A narrow peak between two lines is underestimated by a few percent.
    assert np.mean(ratio > 0.97) > 0.97
    assert np.median(ratio) < 1.5
    # The bands of the bound do not lower any line.
    bound = error_bound([record], [run], WHOLE).at(found.frequency)
    assert np.all((bound >= 0.999 * found.upper)[clear])


def test_the_bound_of_unexcited_lines_follows_from_their_neighbours():
    input = excitation(top=400.0)
    record = Record(input, noisy(answer(STAGE, input)), DT)
    bound = error_bound([record], [answer(STAGE, input)], WHOLE)
    frequency, relative, excited = map(
        np.array, (bound.frequency, bound.relative, bound.excited)
    )
    top = np.flatnonzero(excited)[-1]
    assert 350.0 < frequency[top] < 700.0
    found = relative_error(record, answer(STAGE, input), WHOLE)
    weak = found.frequency[found.margin > 1.0]
    for i in range(top + 2, frequency.size, 20):
        if np.min(np.abs(weak - frequency[i])) < 0.02 * frequency[i]:
            continue  # it also limits the bound
        seen = (frequency[i] / frequency[: top + 1]) ** 2 - 1.0
        share = min(1.0, np.min(np.maximum(relative[: top + 1], ABSORBED) * seen))
        expected = max(relative[top], UNSEEN * share)
        # A band has its largest value.
        assert expected * 0.9 < relative[i] < expected * 1.25
    assert relative.max() == UNSEEN
    assert frequency[-1] == pytest.approx(0.5 * RATE)


def test_a_hidden_mode_of_the_allowed_share_stays_below_the_bound():
    """Test the rule beyond the band with modes there."""
    input = excitation(top=400.0)
    record = Record(input, noisy(answer(STAGE, input)), DT)
    bound = error_bound([record], [answer(STAGE, input)], WHOLE)
    excited = np.array(bound.excited)
    known = np.array(bound.frequency)[excited]
    upper, top = np.array(bound.relative)[excited], known.max()
    for hidden in (1.3 * top, 2.0 * top, 3.0 * top):
        # the largest share k with errors below the bound at every line
        share = np.min(np.maximum(upper, ABSORBED) * ((hidden / known) ** 2 - 1.0))
        lines = np.linspace(1.05 * top, 0.49 * RATE, 400)
        b, a = mode(hidden, 0.02)
        response = scipy.signal.freqs(b, a, 2.0 * np.pi * lines)[1]
        error = min(share, 1.0) * np.abs(response - 1.0)
        below = lines < 1.02 * hidden
        assert np.all(error[below] <= 1.05 * np.maximum(bound.at(lines)[below], share))


def test_periodic_records_have_their_excited_lines():
    period = 2048
    input = np.tile(excitation(samples=period), 8)
    runs = [answer(stage, input) for stage in (STAGE, SLOW)]
    record = Record(input, noisy(runs[0]), DT, period=period)
    found = relative_error(record, runs[1], HALVES[1])
    assert found.resolution == pytest.approx(RATE / period)
    seen = found.frequency < 3000.0
    expected = true_error(STAGE, SLOW, found.frequency[seen])
    np.testing.assert_allclose(found.error[seen], expected, rtol=0.2, atol=0.05)
    assert np.mean(found.upper[seen] > expected) > 0.95


@pytest.mark.parametrize("periods", [2, 3, 4, 8])
@pytest.mark.parametrize("gain", [1.0, 1.2])
def test_the_interval_holds_at_its_level_for_any_number_of_periods(periods, gain):
    """The variance from few periods is uncertain, and a wider interval allows for it.

    For a right model the error is complex and the level is exact. For a wrong one the
    interval of the modulus contains it more often.
    """
    period, inside, sure, draws = 512, [], 0, 40
    random = np.random.default_rng([77, periods])
    for _ in range(draws):
        phases = np.exp(2j * np.pi * random.uniform(size=period // 2 - 1))
        input = np.tile(np.fft.irfft(np.r_[0.0, phases, 0.0]), periods)
        noise = 0.02 * input.std() * random.standard_normal(input.size)
        record = Record(input, gain * input + noise, DT, period=period)
        found = relative_error(record, input, slice(0, input.size))
        inside += [*(np.abs(found.error - (gain - 1.0)) <= found.margin)]
        sure += bool(np.any(found.sure))
        assert found.error.size == period // 2 - 1
    if gain == 1.0:
        assert np.mean(inside) == pytest.approx(0.99, abs=0.004)
        assert sure <= 3  # 1 % of the records
    else:
        assert np.mean(inside) > 0.99


@pytest.mark.parametrize("samples", [1200, 4000])
def test_the_interval_holds_at_its_level_without_periods(samples):
    inside, random = [], np.random.default_rng([78, samples])
    for _ in range(150):
        input = random.standard_normal(samples)
        record = Record(input, input + 0.02 * random.standard_normal(samples), DT)
        found = relative_error(record, input, slice(0, samples))
        inside += [*(found.error <= found.margin)]
    assert np.mean(inside) == pytest.approx(0.99, abs=0.004)


@pytest.mark.parametrize("chance", [0.05, 0.01, 1e-5])
def test_the_half_width_is_a_quantile_of_the_f_distribution(chance):
    for averages in (2.0, 2.84, 3.0, 8.0, 15.0, 100.0):
        quantile = scipy.stats.f.ppf(1.0 - chance, 2, 2.0 * (averages - 1.0))
        found = deviations(averages, chance)
        assert found == pytest.approx(np.sqrt(quantile), rel=1e-8)
    assert np.isfinite(deviations(1.0, chance))


def test_of_several_records_the_larger_error_counts():
    inputs = [excitation(1), excitation(2, 400.0)]
    models = (product(lag(1e-3), mode(780.0, 0.02)), product(lag(1.3e-3)))
    records = [Record(x, noisy(answer(STAGE, x)), DT) for x in inputs]
    runs = [answer(model, x) for model, x in zip(models, inputs, strict=True)]
    alone = [error_bound([r], [y], WHOLE) for r, y in zip(records, runs, strict=True)]
    both = error_bound(records, runs, WHOLE)
    low, high = np.array([50.0, 200.0]), np.array([2000.0, 3000.0])
    np.testing.assert_array_equal(both.at(low), alone[1].at(low))
    np.testing.assert_array_equal(both.at(high), alone[0].at(high))
    assert np.all(both.excited_at(high))


def test_no_peak_is_lost_between_the_lines_of_another_record():
    wide, narrow = (
        ErrorBound(
            frequency=tuple(lines),
            relative=tuple(np.where(lines == 810.0, 5.0, 0.1)),
            excited=(True,) * lines.size,
        )
        for lines in (np.geomspace(10.0, 5000.0, 60), np.arange(760.0, 901.0, 10.0))
    )
    both = joined([wide, narrow])
    for line, relative in zip(narrow.frequency, narrow.relative, strict=True):
        assert both.at(line) >= relative
    assert both.at(700.0) == both.at(950.0) == 0.1
    assert joined([narrow, wide]) == both


# Statistics


def test_autocorrelation_equals_the_sums():
    white = np.random.default_rng(0).normal(size=300)
    signal = np.asarray(scipy.signal.lfilter([1.0], [1.0, 0.5], white))
    centred = signal - signal.mean()
    sums = [
        sum(centred[k] * centred[k - lag] for k in range(lag, 300)) for lag in range(26)
    ]
    found = autocorrelation(signal)
    values = np.array(sums[1:]) / sums[0]
    place = np.argmax(np.abs(values))
    assert (found.lag, found.value) == (place + 1, pytest.approx(values[place]))
    assert found.bound == pytest.approx(3.54 / np.sqrt(300))


def test_cross_correlation_uses_earlier_inputs():
    input = np.random.default_rng(0).normal(size=2000)
    found = cross_correlation(np.roll(input, 7), input)
    assert found.lag == 7
    assert found.value > 0.95
    assert found.significant


def test_the_bound_of_the_correlation_includes_both_spectra():
    """Independent coloured signals seldom exceed it, but often the white bound."""
    random = np.random.default_rng(4)
    exceeded = naive = 0
    for _ in range(400):
        white = random.standard_normal((2, 1200))
        error, input = np.asarray(scipy.signal.lfilter([1.0], [1.0, -0.95], white))[
            :, 200:
        ]
        found = cross_correlation(error, input)
        at_zero = np.corrcoef(error, input)[0, 1]
        exceeded += abs(at_zero) > found.bound
        naive += abs(at_zero) > 3.54 / np.sqrt(1000)
    assert exceeded <= 0.01 * 400
    assert naive > 0.2 * 400


# Columns and units

TIME = DT * np.arange(SAMPLES)
OTHER = np.cumsum(np.random.default_rng(8).standard_normal(SAMPLES)) / 50.0
"""Drift of another sensor."""


@pytest.mark.parametrize(
    ("input", "output", "message"),
    [
        (TIME, OUTPUT, "the input column looks like a time axis: it rises steadily"),
        (INPUT, TIME, "the output column looks like a time axis"),
        (INPUT, -OUTPUT, "move in opposite directions"),
        (INPUT, OTHER, "the output does not follow the input"),
        (OUTPUT, INPUT, "are the columns swapped"),
        (INPUT, 1e3 * OUTPUT, "spans .* more than any piezo stage: check the unit"),
        (1e3 * INPUT, OUTPUT, "input spans .* more than any piezo stage"),
        (INPUT, 1e-3 * OUTPUT, "um/V; piezo stages move"),
    ],
)
def test_implausible_columns_are_named(input, output, message):
    warnings = plausibility_warnings(Record(input, output, DT))
    assert len(warnings) == 1
    with pytest.raises(ValueError, match=message):
        raise ValueError(warnings[0])


@pytest.mark.parametrize("seed", range(5))
def test_plausible_columns_pass(seed):
    input = excitation(seed)
    output = noisy(answer(STAGE, input), seed)
    assert plausibility_warnings(Record(input, output, DT)) == []
    nanometres = Record(input, 1e3 * output, DT, output_units="nm")
    assert plausibility_warnings(nanometres) == []


@pytest.mark.parametrize(
    ("column", "even"),
    [
        ([3.0], False),
        ([3.0, 4.0], False),
        ([3.0, 4.0, 5.0], True),
        ([3.0, 4.0, 6.0], False),
        ([5.0, 4.0, 3.0], False),
        ([3.0, np.nan, 5.0], False),
    ],
)
def test_a_time_axis_has_three_samples_in_even_steps(column, even):
    assert rises_evenly(np.array(column)) is even


# In a fit


@pytest.fixture(scope="module")
def short():
    return Record(INPUT[:6000], OUTPUT[:6000], DT, source="made up")


def test_only_a_fit_without_the_mode_has_an_alarm(short, tmp_path):
    fits = [identify(short, model) for model in ("lag", "mode+lag")]
    poor, right = (fit.report for fit in fits)
    assert any("leaves a peak at 7" in text for text in poor.alarms)
    assert set(poor.alarms) <= set(poor.warnings)
    assert right.alarms == []
    assert right.warnings == []
    bounds = [
        fit.about.error_bound.at([780.0])[0]
        for fit in fits
        if fit.about.error_bound is not None
    ]
    assert bounds[0] > 10.0
    assert bounds[1] < 0.3
    save(fits[1].system, tmp_path / "model.json", fits[1].about)
    about = read_about(tmp_path / "model.json")
    assert about.error_bound == fits[1].about.error_bound
    assert about.error_bound is not None
    assert about.standard_errors["dynamics.frequency"] > 0.0
    again = FitReport.model_validate_json(right.model_dump_json())
    assert again.residuals == right.residuals
