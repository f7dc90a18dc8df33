import numpy as np
import pytest

from piezojax import (
    Record,
)
from piezojax.identification import average_periods
from piezojax.identification.records.resample import resample

DT = 2e-3
SAMPLES = 64
TONES = ((1, 0.7, 0.3), (5, 1.0, -1.1), (20, 0.4, 2.0))  # line, amplitude, phase


def angle(line):
    return 2.0 * np.pi * line / (SAMPLES * DT)


def signal(time, sign=1.0):
    return 0.2 + sum(a * np.cos(angle(k) * time + sign * p) for k, a, p in TONES)


def mean_ahead(time, step):
    """Return the mean of `signal` from `time` to `time + step`, in closed form."""
    return 0.2 + sum(
        a
        * (np.sin(angle(k) * (time + step) + p) - np.sin(angle(k) * time + p))
        / (angle(k) * step)
        for k, a, p in TONES
    )


def record(periods=1, **changed):
    time = DT * np.arange(periods * SAMPLES)
    values = {
        "inputs": signal(time),
        "outputs": np.stack([signal(time, -1.0), 3.0 * signal(time)], axis=1),
        "dt": DT,
        "input_units": "N",
        "output_units": ("m", "um"),
        "source": "tones",
        "period": SAMPLES,
    }
    return Record(**values | changed)


@pytest.mark.parametrize("factor", [1, 2, 7])
def test_interpolated_samples_equal_the_tones(factor):
    found = resample(record(), factor)
    time = DT / factor * np.arange(factor * SAMPLES)
    assert (found.dt, found.period) == (DT / factor, factor * SAMPLES)
    assert (found.input_units, found.output_units) == (("N",), ("m", "um"))
    expected = np.stack([signal(time, -1.0), 3.0 * signal(time)], axis=1)
    np.testing.assert_allclose(found.outputs, expected, rtol=0.0, atol=1e-12)
    expected = mean_ahead(time, DT / factor)
    np.testing.assert_allclose(found.input, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("samples", [64, 65])
def test_existing_samples_are_kept(samples):
    draw = np.random.default_rng(0).standard_normal((2, samples))
    whole = Record(*draw, DT, period=samples)
    found = resample(whole, 4).output[::4]
    np.testing.assert_allclose(found, draw[1], rtol=0.0, atol=1e-12)


def test_means_are_over_the_periods_after_the_first():
    draw = np.random.default_rng(0)
    noisy = record(5, outputs=draw.standard_normal((5 * SAMPLES, 2)))
    found = average_periods(noisy)
    expected = noisy.outputs.reshape(5, SAMPLES, 2)[1:].mean(axis=0)
    np.testing.assert_allclose(found.outputs, expected, rtol=1e-14)
    np.testing.assert_allclose(found.inputs, record().inputs, rtol=0.0, atol=1e-12)
    assert found.period == found.samples == SAMPLES


def test_samples_after_the_last_period_are_omitted():
    whole = record(3)
    longer = record(
        inputs=np.concatenate([whole.inputs, np.full((9, 1), 1e6)]),
        outputs=np.concatenate([whole.outputs, np.full((9, 2), 1e6)]),
    )
    for skip in (0, 1, 2):
        found = average_periods(longer, skip)
        np.testing.assert_allclose(found.outputs, record().outputs, atol=1e-12)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda: average_periods(record(period=None)), "tones: the record has no per"),
        (
            lambda: average_periods(record(3), 3),
            "skip is 3; it must be at least 0 and below the 3 whole periods",
        ),
        (lambda: average_periods(record(3), -1), "skip is -1"),
        (lambda: resample(record(2)), "tones: 128 samples with period 64; resampling"),
        (lambda: resample(record(period=None)), "64 samples with period None"),
        (lambda: resample(record(), 0), "factor is 0; it must be at least 1"),
    ],
)
def test_bad_requests_are_refused(action, message):
    with pytest.raises(ValueError, match=message):
        action()
