"""Periodic records: the mean over their periods, and samples between their samples."""

from dataclasses import replace

import numpy as np

from .record import Record


def average_periods(record: Record, skip: int = 1) -> Record:
    """Return the mean of the record's periods after the first ``skip``.

    The first holds the transient from rest; averaging P periods divides the sensor's
    noise by sqrt(P) and keeps all that repeats. Samples after the last whole period are
    left out. Raises ValueError for a record without ``period``, or too few periods.
    """
    period = record.period
    if period is None:
        raise ValueError(f"{record.source}: the record has no period to average over")
    count = record.samples // period
    if not 0 <= skip < count:
        raise ValueError(
            f"skip is {skip}; it must be at least 0 and below the {count} whole periods"
        )
    kept = slice(skip * period, count * period)

    def mean(columns: np.ndarray) -> np.ndarray:
        periods = columns[kept].reshape(count - skip, period, -1)
        return periods.mean(axis=0)

    return replace(record, inputs=mean(record.inputs), outputs=mean(record.outputs))


def whole_periods(record: Record, train: slice) -> Record:
    """Return the samples ``train`` of a periodic record, cut to whole periods.

    Raises ValueError for a record without ``period`` or a part without a whole one.
    """
    if record.period is None:
        raise ValueError(f"{record.source}: this method needs the record's period")
    count = (train.stop - train.start) // record.period
    if count == 0:
        raise ValueError(
            f"{record.source}: {train.stop - train.start} samples to fit on hold no "
            f"whole period of {record.period}"
        )
    part = slice(train.start, train.start + count * record.period)
    return replace(record, inputs=record.inputs[part], outputs=record.outputs[part])


def resample(record: Record, factor: int = 1) -> Record:
    """Return ``record``, one period, with ``factor`` samples for each of its own.

    For an excitation that is smooth between its samples (a band-limited multisine) and
    models that hold their input: output k is that at the instant k, input k the mean
    over the sample that starts there. Both are exact for a periodic signal without
    content from half the sampling rate up. At ``factor`` 1 only the inputs change.
    Raises ValueError if the record is not exactly one period or ``factor`` is below 1.
    """
    if record.period != record.samples:
        raise ValueError(
            f"{record.source}: {record.samples} samples with period {record.period}; "
            "resampling needs exactly one period"
        )
    if factor < 1:
        raise ValueError(f"factor is {factor}; it must be at least 1")
    samples = factor * record.samples
    # The mean of exp(i w t) from t to t + h is exp(i w t) exp(i w h/2) sinc(w h/2).
    angle = np.pi * np.fft.rfftfreq(samples)[: record.samples // 2 + 1, None]
    held = np.exp(1j * angle) * np.sinc(angle / np.pi)
    return replace(
        record,
        inputs=_through(held, record.inputs, samples),
        outputs=_through(np.ones_like(angle), record.outputs, samples),
        dt=record.dt / factor,
        period=samples,
    )


def _through(response: np.ndarray, columns: np.ndarray, samples: int) -> np.ndarray:
    spectrum = response * np.fft.rfft(columns, axis=0)
    if samples > len(columns) and len(columns) % 2 == 0:
        spectrum[-1] *= 0.5  # half the sampling rate, now with its mirror image
    return np.fft.irfft(spectrum, samples, axis=0) * (samples / len(columns))
