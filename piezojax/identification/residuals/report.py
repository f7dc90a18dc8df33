"""Residual analysis of a fit: report and warnings."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

from ...core.error_bound import ErrorBound
from ..estimators.projection import motion
from ..records.record import Record
from .bound import RelativeError, error_bound, relative_error
from .correlation import Correlation, autocorrelation, cross_correlation
from .coverage import Coverage, Unseen, coverage_of, unseen_in
from .peaks import LEAST, VISIBLE, Peak, joined_peaks, unmodelled_peaks

OTHER_GAIN = 1.25
"""Least factor between the motions of stage and model that raises a warning."""

GROSS = 10.0
"""Size of a peak that the model lacks, as a multiple of the model's own gain, that
raises an alarm: a controller designed on this model does not suit the stage."""

WIDE = 0.5
"""Share of the lines in an octave with an error above the model's gain that counts as
a wrong response."""


class ResidualReport(BaseModel):
    """Analysis of the free-run error over the validation part.

    ``whiteness`` holds the autocorrelation of each output's residual,
    ``input_correlation`` its correlation with each input (outputs vary slowest). For
    records of a closed loop it is the correlation with the reference and the dither,
    because the input contains noise. ``peaks`` are resonances that the model lacks.
    ``coverage`` is the band and range of the whole records, ``unseen`` the part of
    validation that training does not cover.
    ``error_bound`` bounds the relative error of the model over frequency; it is None,
    and ``peaks`` is empty, for records of several inputs or outputs, and for records
    that are too short.
    """

    whiteness: list[Correlation]
    input_correlation: list[Correlation]
    peaks: list[Peak]
    coverage: Coverage
    unseen: Unseen
    error_bound: ErrorBound | None


def _independent(record: Record) -> np.ndarray:
    """Return the signals [samples, k] that are independent of the noise."""
    return record.excitation if record.excitation.size else record.inputs


class Faults(NamedTuple):
    """Bound on the error of a model, resonances that it lacks, and its warnings.

    ``alarms`` are the warnings of resonances that make the model useless for a loop.
    """

    bound: ErrorBound | None
    peaks: list[Peak]
    alarms: list[str]
    warnings: list[str]


def residual_report(
    records: Sequence[Record],
    runs: Sequence[np.ndarray],
    train: slice,
    validate: slice,
) -> tuple[ResidualReport, list[str], list[str]]:
    """Return the analysis of the free ``runs`` [samples, p], its alarms and warnings.

    ``train`` and ``validate`` are the samples of each record that the model was fitted
    and validated on.
    """
    errors = np.concatenate(
        [(r.outputs - run)[validate] for r, run in zip(records, runs, strict=True)]
    )
    inputs = np.concatenate([_independent(record)[validate] for record in records])
    faults = model_faults(records, runs, validate)
    report = ResidualReport(
        whiteness=[autocorrelation(error) for error in errors.T],
        input_correlation=[
            cross_correlation(error, input) for error in errors.T for input in inputs.T
        ],
        peaks=faults.peaks,
        coverage=coverage_of(records, faults.bound),
        unseen=unseen_in(records, train, validate),
        error_bound=faults.bound,
    )
    return (
        report,
        faults.alarms,
        [
            *faults.warnings,
            *_coverage_warnings(report, records[0].dt),
            *_unseen_warnings(report.unseen, records[0].input_units),
        ],
    )


def model_faults(
    records: Sequence[Record], runs: Sequence[np.ndarray], part: slice
) -> Faults:
    """Return bound, peaks, alarms and warnings from the free ``runs`` [samples, p].

    Bound and peaks are those of ``ResidualReport``. The bound holds for the whole
    records; everything else holds over ``part``.
    """
    bound, errors = _relative(records, runs, part)
    peaks = joined_peaks([unmodelled_peaks(error) for error in errors])
    gross = [peak for peak in peaks if peak.times_gain > GROSS]
    return Faults(
        bound,
        peaks,
        [*_peak_warnings(gross), *([] if peaks else _response_warnings(errors))],
        [
            *_peak_warnings(peak for peak in peaks if peak.times_gain <= GROSS),
            *_gain_warnings(records, runs, part),
        ],
    )


def _relative(
    records: Sequence[Record], runs: Sequence[np.ndarray], validate: slice
) -> tuple[ErrorBound | None, list[RelativeError]]:
    """Return the bound over the whole records, and the relative errors over validation.

    Records with a short or constant validation part are left out of the errors. The
    bound is None, and there are no errors, if all are left out, if a whole record is
    short or constant, and for records of several channels.
    """
    if not all(record.single for record in records):
        return None, []
    errors = []
    single = [run[:, 0] for run in runs]
    for record, run in zip(records, single, strict=True):
        if record.samples > validate.start:
            with suppress(ValueError):
                errors.append(relative_error(record, run, validate))
    if not errors:
        return None, []
    try:
        whole = slice(0, max(record.samples for record in records))
        return error_bound(records, single, whole), errors
    except ValueError:
        return None, []


def _peak_warnings(peaks: Iterable[Peak]) -> Iterator[str]:
    for peak in peaks:
        yield (
            f"the model leaves a peak at {peak.frequency_Hz:.4g} Hz, "
            f"{peak.times_gain:.3g} times its own gain there: a resonance is missing "
            "or wrong; before tuning, fit a model with a mode (--model ...+mode+lag), "
            "or if it has one, its modes alone (identify --response, then --dynamics)"
        )


def _response_warnings(errors: Iterable[RelativeError]) -> Iterator[str]:
    """Yield a warning if an error exceeds the model's gain in most of an octave."""
    wrong = [place for error in errors if (place := _wrong_from(error)) is not None]
    if wrong:
        yield (
            f"from {min(wrong):.4g} Hz on the model is wrong by more than "
            "its own gain. If its dynamics are too simple, fit a model with a mode, a "
            "lag or a delay (--model ...+mode+lag+delay) before tuning; if the output "
            "was smoothed after it was measured, use it as it was measured"
        )


def _wrong_from(found: RelativeError) -> float | None:
    """Return the start (Hz) of a wrong response (``WIDE``), None without one."""
    seen = found.gain > VISIBLE * found.gain[0]
    wrong = found.sure & (found.lower > LEAST) & seen
    for i in np.flatnonzero(wrong):
        ratio = found.frequency / found.frequency[i]
        octave = (ratio >= 1.0) & (ratio < 2.0)
        if octave.sum() >= 4 and wrong[octave].mean() > WIDE:
            return float(found.frequency[i])
    return None


def _gain_warnings(
    records: Sequence[Record], runs: Sequence[np.ndarray], validate: slice
) -> Iterator[str]:
    # The sensor of each record has its own zero.
    measured, modelled = (
        np.concatenate(
            [
                motion(r, each, validate)
                for r, each in zip(records, signals, strict=True)
            ]
        )
        for signals in ([record.outputs for record in records], runs)
    )
    powers = np.sum(modelled**2, axis=0)
    factors = np.sum(modelled * measured, axis=0) / np.maximum(powers, 1e-300)
    for output, factor in enumerate(factors):
        if not 1.0 / OTHER_GAIN < factor < OTHER_GAIN:
            yield (
                f"output {output} moves {factor:.3g} times as far as the model: "
                "the model is that of another stage or unit, or the fit failed; fit a "
                "model to this record"
            )


def _coverage_warnings(report: ResidualReport, dt: float) -> Iterator[str]:
    bound = report.error_bound
    if bound is not None and any(bound.excited) and bound.narrow:
        yield (
            f"the record excites nothing above {bound.highest:.3g} Hz: a "
            "resonance above it stays unseen, and gains tuned on this model are not "
            f"validated there; record a chirp or noise up to {0.2 / dt:.3g} Hz "
            "(python -m piezojax.excite writes one)"
        )


def _unseen_warnings(unseen: Unseen, units: Sequence[str]) -> Iterator[str]:
    if unseen.band_Hz is not None:
        low, high = unseen.band_Hz
        yield (
            f"the validation part holds frequencies from {low:.3g} to {high:.3g} Hz "
            "that the training part does not: the model was not fitted there; choose "
            "parts that hold the same frequencies (--train, --validate)"
        )
    if unseen.input_range is not None:
        low, high = unseen.input_range
        name = "input" if len(units) == 1 else f"input {unseen.input}"
        yield (
            f"the validation part's {name} goes from {low:.3g} to {high:.3g} "
            f"{units[unseen.input]}, beyond that of the training part: the "
            "model was not fitted there; choose parts of the same range "
            "(--train, --validate)"
        )
