"""Responses from records: variances and bands against Monte Carlo and closed forms."""

import dataclasses

import numpy as np
import pytest
from oracles import closed_loop, multisines
from oracles.multisines import DT, LINES, PERIOD

from piezojax.identification.estimators.local_polynomial import (
    local_polynomial,
    periodic_local_polynomial,
)
from piezojax.identification.estimators.robust import robust_response, steady_response
from piezojax.identification.measured_response import (
    ResponseSettings,
    distortion_level,
    measure_responses,
)
from piezojax.identification.records.record import Record

DRAWS = 12


def records(seed, realisations, periods, *, cubic=0.0, noise=0.0, amplitude=1.0):
    """Return records of ``periods`` (0: of a normal input without period)."""
    random = np.random.default_rng([31, seed])
    found = []
    for i in range(realisations):
        one = multisines.multisine(random)
        input = np.tile(one, periods) if periods else random.standard_normal(12_000)
        output = multisines.output(input, random, cubic, noise)
        period = PERIOD if periods else None
        found.append(
            Record(amplitude * input, output, DT, source=f"{i}", period=period)
        )
    return found


CASES = {
    "robust, noise": ("robust", 5, 4, 0.0),
    "robust, distortion": ("robust", 5, 4, 0.03),
    "robust, two realisations": ("robust", 2, 4, 0.03),
    "robust, one realisation": ("robust", 1, 5, 0.0),
    "local polynomial, one realisation": ("local_polynomial", 1, 3, 0.0),
    "local polynomial, distortion": ("local_polynomial", 5, 2, 0.03),
    "local polynomial, normal input": ("local_polynomial", 1, 0, 0.0),
    "welch, normal input": ("welch", 1, 0, 0.0),
}


@pytest.mark.parametrize("case", CASES)
def test_bands_hold_at_their_level_and_variances_are_those_of_the_errors(case):
    method, realisations, periods, cubic = CASES[case]
    errors, variances, magnitudes, phases = [], [], [], []
    for seed in range(DRAWS if periods else 4):
        of = records(seed, realisations, periods, cubic=cubic, noise=0.02)
        ((found, _),) = measure_responses(of, ResponseSettings(method=method))
        true = multisines.exact(found.frequency, cubic)
        magnitude, phase = found.band()
        magnitudes += [*(np.abs(np.abs(found.values) - np.abs(true)) <= magnitude)]
        phases += [*(np.abs(np.angle(found.values / true)) <= phase)]
        errors += [*(np.abs(found.values - true) ** 2 / np.abs(true) ** 2)]
        variances += [*(found.variance / np.abs(true) ** 2)]
    assert 0.93 < np.mean(magnitudes) < 0.97
    assert 0.93 < np.mean(phases) < 0.97
    assert np.mean(variances) == pytest.approx(np.mean(errors), rel=0.15)


def test_noise_and_distortion_are_told_apart():
    cubic, noise = 0.03, 0.02
    found = [
        measure_responses(
            records(seed, 6, 4, cubic=cubic, noise=noise),
            ResponseSettings(method="robust"),
        )[0][0]
        for seed in range(DRAWS)
    ]
    # White noise in three periods, over the lines of a multisine of rms value 1.
    power = PERIOD / (2.0 * LINES.size)
    assert np.mean([one.noise for one in found]) == pytest.approx(
        noise**2 / power / 3 / 6, rel=0.05
    )
    # The scatter of responses without noise, over many other realisations.
    clean = []
    for seed in range(100, 150):
        (record,) = records(seed, 1, 4, cubic=cubic)
        clean.append(steady_response(record.input, record.output, DT, PERIOD))
    scatter = np.var([one.response for one in clean], axis=0, ddof=1)
    assert np.mean([one.distortion for one in found]) == pytest.approx(
        np.mean(scatter), rel=0.1
    )
    level = distortion_level(found[0])
    assert np.median(level / np.sqrt(scatter)) == pytest.approx(1.0, abs=0.2)


def test_no_distortion_is_claimed_of_a_linear_stage():
    claimed = 0
    for seed in range(DRAWS):
        ((found, told),) = measure_responses(
            records(seed, 4, 4, noise=0.02), ResponseSettings(method="robust")
        )
        claimed += distortion_level(found) is not None
    assert claimed <= 1
    assert "differ by no more than the noise" in told.notes[0] or claimed


def test_the_local_polynomial_removes_transients_and_leakage():
    (record,) = records(1, 1, 2)
    found = periodic_local_polynomial(record.input, record.output, DT, PERIOD)
    exact = multisines.exact(found.frequency)
    spectra = np.fft.rfft(np.stack([record.input, record.output]).reshape(2, 2, -1))
    plain = np.divide(*spectra.mean(axis=1)[::-1, LINES])
    ours, theirs = (np.max(np.abs(g - exact)) for g in (found.response, plain))
    assert theirs > 0.05
    assert ours < 0.01
    (record,) = records(1, 1, 0)
    polynomial = local_polynomial(record.input, record.output, DT)
    ((welch, _),) = measure_responses([record], ResponseSettings(method="welch"))
    ours, theirs = (
        np.median(np.abs(g / multisines.exact(f) - 1.0))
        for f, g in (
            (polynomial.frequency, polynomial.response),
            (welch.frequency, welch.values),
        )
    )
    assert ours < 0.02 * theirs


def test_noise_of_the_input_counts():
    random, errors, variances = np.random.default_rng(5), [], []
    for _ in range(40):
        one = np.tile(multisines.multisine(random), 4)
        noise = 0.05 * random.standard_normal((2, one.size))
        found = steady_response(one + noise[0], 2.0 * one + noise[1], DT, PERIOD)
        driven = np.isin(np.round(found.frequency * PERIOD * DT), LINES)
        errors += [*(np.abs(found.response - 2.0) ** 2)[driven]]
        variances += [*found.variance[driven]]
    assert np.mean(variances) == pytest.approx(np.mean(errors), rel=0.1)


def test_amplitudes_are_told_apart_and_realisations_are_cut():
    low = records(1, 2, 3, amplitude=0.5)
    high = records(2, 2, 3)
    found = measure_responses([*high, *low], ResponseSettings(method="robust"))
    assert [one.amplitude for one, _ in found] == pytest.approx([0.5, 1.0])
    assert [told.realisations for _, told in found] == [2, 2]
    both = [np.concatenate([getattr(r, k)[:, 0] for r in high]) for k in SIDES]
    joined = Record(*both, DT, period=PERIOD)
    ((again, _),) = measure_responses(
        [joined], ResponseSettings(method="robust", realisations=2)
    )
    np.testing.assert_allclose(again.values, found[1][0].values)
    np.testing.assert_allclose(again.variance, found[1][0].variance)


SIDES = "inputs", "outputs"


@pytest.mark.parametrize(
    ("method", "periods", "more", "message"),
    [
        ("fourier", 3, {}, "'fourier' is unknown; for a response there are welch, loc"),
        ("robust", 0, {}, "robust needs the --period of the multisine"),
        ("robust", 2, {}, "hold 2 periods of 1000; without the first 1, two or more"),
        ("welch", 2, {}, "welch does not use a period"),
        ("welch", 0, {"segment": 8}, "the segment is 8 samples; it must be at least"),
        (
            "local_polynomial",
            1,
            {},
            "period is 1000 samples; 1000 samples must hold",
        ),
    ],
)
def test_what_a_method_cannot_do_is_refused(method, periods, more, message):
    with pytest.raises(ValueError, match=message):
        measure_responses(
            records(0, 1, periods), ResponseSettings(method=method, **more)
        )


def test_realisations_must_excite_the_same_lines():
    one = steady_response(*_tone(LINES[:100]), DT, PERIOD)
    other = steady_response(*_tone(LINES[80:180]), DT, PERIOD)
    with pytest.raises(ValueError, match="only 20 of 100 lines are excited in all"):
        robust_response([one, other])
    with pytest.raises(ValueError, match="one realisation cannot separate"):
        robust_response([one])
    rates = [*records(0, 1, 3), Record(*_tone(LINES), 2 * DT, period=PERIOD)]
    with pytest.raises(ValueError, match=r"differ in \(rate, period, unit of input"):
        measure_responses(rates, ResponseSettings(method="robust"))


def _tone(lines):
    spectrum = np.zeros(PERIOD // 2 + 1, complex)
    spectrum[lines] = np.exp(1j * np.arange(lines.size) ** 2)
    signal = np.tile(np.fft.irfft(spectrum, PERIOD), 3)
    return signal, 2.0 * signal


# Closed loops


def loop(seed, samples=20_000, size=0.02):
    """Return the record of a loop with a binary reference and dither, and noise."""
    draw = np.random.default_rng([8, seed])
    r, d = (a * draw.choice([-1.0, 1.0], samples) for a in (0.2, 0.4))
    noise = closed_loop.noise(draw, samples, size)
    u, y = closed_loop.run(closed_loop.CONTROLLERS["PI with notch"], r, d, noise)
    return Record(u, y, closed_loop.DT, reference=r, dither=d, source="loop")


def test_welch_of_a_closed_loop_is_not_biased_by_its_noise():
    record, welch = loop(1), ResponseSettings(method="welch", segment=512)
    ((found, _),) = measure_responses([record], welch)
    blind = dataclasses.replace(record, reference=None, dither=None)
    ((naive, _),) = measure_responses([blind], welch)

    def outside(one):
        """Return the share of lines at which the truth is outside the 95 % band."""
        kept = (one.frequency > 30.0) & (one.frequency < 3000.0)
        kept &= np.abs(one.frequency - closed_loop.FREQUENCY) > 150.0
        size = np.abs(closed_loop.stage_response(one.frequency))
        return np.mean((np.abs(np.abs(one.values) - size) > one.band()[0])[kept])

    assert outside(found) < 0.1
    assert outside(naive) > 0.3


def test_realisations_of_a_loop_are_cut_with_their_excitation():
    record = loop(2, 8000, 0.002)
    ((found, told),) = measure_responses(
        [record], ResponseSettings(method="welch", realisations=2, segment=512)
    )
    halves = [record.during(part) for part in (slice(4000), slice(4000, None))]
    ((again, _),) = measure_responses(
        halves, ResponseSettings(method="welch", segment=512)
    )
    assert told.realisations == 2
    np.testing.assert_array_equal(found.values, again.values)


@pytest.mark.parametrize(
    ("method", "reference", "message"),
    [
        ("local_polynomial", None, "loop: local_polynomial takes .* use welch, or"),
        ("welch", np.ones(2000), "reference and dither never change"),
    ],
)
def test_loops_that_a_method_does_not_take_are_refused(method, reference, message):
    record = loop(3, 2000)
    if reference is not None:
        record = dataclasses.replace(record, reference=reference, dither=None)
    with pytest.raises(ValueError, match=message):
        measure_responses([record], ResponseSettings(method=method))
