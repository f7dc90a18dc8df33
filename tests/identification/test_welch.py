"""Empirical frequency responses of two signals, against transfer functions."""

import numpy as np
import pytest
import scipy.signal

from piezojax.identification.estimators.welch import spectral_response

DT = 1e-4
B, A = scipy.signal.cont2discrete(
    ([4900.0**2], [1.0, 2 * 0.05 * 4900.0, 4900.0**2]), DT
)[:2]
B = np.ravel(B)


def exact(frequency):
    return scipy.signal.freqz(B, A, 2.0 * np.pi * frequency * DT)[1]


def noise(samples, seed, size=1.0):
    return size * np.random.default_rng(seed).standard_normal(samples)


def test_a_periodic_record_gives_the_exact_response():
    period = 512
    input = np.tile(noise(period, 1), 12)
    output = scipy.signal.lfilter(B, A, input)
    found = spectral_response(
        input[-4 * period :], output[-4 * period :], DT, period=512
    )
    np.testing.assert_allclose(found.frequency, np.arange(1, 257) / (512 * DT))
    np.testing.assert_allclose(found.response, exact(found.frequency), atol=1e-6)
    np.testing.assert_allclose(found.coherence, 1.0, atol=1e-9)


@pytest.mark.parametrize("period", [None, 500])
def test_the_variance_equals_that_over_noise_draws(period):
    samples = 8000
    flat = np.exp(2j * np.pi * np.random.default_rng(2).uniform(size=249))
    tones = np.fft.irfft(np.r_[0.0, flat, 0.0], 500) * np.sqrt(500.0)
    input = noise(samples, 2) if period is None else np.tile(tones, 16)
    clean = input * 3.0
    draws = [
        spectral_response(input, clean + noise(samples, s, 0.4), DT, period=period)
        for s in range(10, 70)
    ]
    scatter = np.mean(np.abs(np.array([d.response for d in draws]) - 3.0) ** 2)
    assert np.mean([d.variance for d in draws]) == pytest.approx(scatter, rel=0.1)
    coherence = 9.0 / (9.0 + 0.16)
    assert np.mean([d.coherence for d in draws]) == pytest.approx(coherence, abs=5e-3)


def test_welch_finds_a_resonance():
    input = noise(60_000, 4)
    output = scipy.signal.lfilter(B, A, input) + noise(60_000, 5, 0.01)
    found = spectral_response(input, output, DT, segment=2048)
    deviation = np.abs(found.response - exact(found.frequency))
    assert np.median(deviation / np.sqrt(found.variance)) < 1.5
    peak = found.frequency[np.argmax(np.abs(found.response))]
    assert peak == pytest.approx(4900.0 / (2 * np.pi), abs=1.0 / (2048 * DT))


def test_lines_without_input_are_omitted():
    input = np.sin(2 * np.pi * 7 * np.arange(1000) / 100)
    found = spectral_response(input, 2.0 * input, DT, period=100)
    np.testing.assert_allclose(found.frequency, [700.0])
    np.testing.assert_allclose(found.response, [2.0])


@pytest.mark.parametrize(
    ("output", "more", "message"),
    [
        (np.ones(99), {}, r"input has the shape \(100,\) and output \(99,\)"),
        (np.ones(100), {"period": 60}, "the period is 60 samples; 100 samples must"),
        (np.ones(100), {"period": 1}, "the period is 1 samples"),
        (np.ones(100), {"segment": 90}, "the segment is 90 samples"),
        (np.ones(100), {"segment": 8}, "it must be at least 32"),
    ],
)
def test_bad_signals_are_refused(output, more, message):
    with pytest.raises(ValueError, match=message):
        spectral_response(noise(100, 0), output, DT, **more)


def test_a_constant_input_is_refused():
    with pytest.raises(ValueError, match="the input never changes"):
        spectral_response(np.ones(100), noise(100, 0), DT)
