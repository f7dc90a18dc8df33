"""Periodic records: averaging over periods, and resampling to a finer grid."""

from dataclasses import replace

import numpy as np

from .record import Record


def average_periods(record: Record, skip: int = 1) -> Record:
    """Return the mean of the record's periods after the first ``skip``.

    The first period holds the transient from rest. Averaging P periods divides the
    sensor noise by sqrt(P) and keeps the periodic part. Samples after the last whole
    period are left out. Raises ValueError for a record without ``period``, or if
    ``skip`` leaves no whole period.
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
        periods = columns[kept].reshape(count - skip, period, *columns.shape[1:])
        return periods.mean(axis=0)

    return replace(
        record,
        inputs=mean(record.inputs),
        outputs=mean(record.outputs),
        reference=None if record.reference is None else mean(record.reference),
        dither=None if record.dither is None else mean(record.dither),
    )


def whole_periods(record: Record, train: slice) -> Record:
    """Return the samples ``train`` of a periodic record, cut to whole periods.

    Raises ValueError for a record without ``period`` or a part below one period.
    """
    if record.period is None:
        raise ValueError(f"{record.source}: this method needs the record's period")
    count = (train.stop - train.start) // record.period
    if count == 0:
        raise ValueError(
            f"{record.source}: {train.stop - train.start} samples to fit on hold no "
            f"whole period of {record.period}"
        )
    return record.during(slice(train.start, train.start + count * record.period))


def resample(record: Record, factor: int = 1) -> Record:
    """Resample ``record``, one period, to ``factor`` times its sampling rate.

    The excitation must be smooth between its samples (a band-limited multisine), and
    the model must hold its input over a sample. Output k is the value at the instant k.
    Input k is the mean over the sample that starts at the instant k. Both are exact for
    a periodic signal without content at or above half the sampling rate. With a
    ``factor`` of 1 only the inputs change. A reference and a dither are left out.
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
        inputs=_filtered(held, record.inputs, samples),
        outputs=_filtered(np.ones_like(angle), record.outputs, samples),
        dt=record.dt / factor,
        period=samples,
        reference=None,
        dither=None,
    )


def _filtered(response: np.ndarray, columns: np.ndarray, samples: int) -> np.ndarray:
    spectrum = response * np.fft.rfft(columns, axis=0)
    if samples > len(columns) and len(columns) % 2 == 0:
        spectrum[-1] *= 0.5  # half the sampling rate: shared with its mirror image
    return np.fft.irfft(spectrum, samples, axis=0) * (samples / len(columns))
