"""Validation of a saved model on other records of its stage."""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel

from ..core.about import About
from ..core.error_bound import ErrorBound
from ..core.system import System, accepts, rest_output
from ..dynamics.linearise import sample_time
from .estimators.free_runs import first_covering
from .estimators.projection import excited_columns
from .estimators.start_search import start_of
from .records.record import LARGEST, Record
from .residuals.bound import joined
from .residuals.report import model_faults
from .residuals.share import POOR, of_output, unexplained_shares

SHARE = 0.2
"""First share of a record, on which its initial state and zero are estimated."""

COVERED = 0.9
"""Share of its range in the record that each input should cover within that part. Until
then no model distinguishes the zero from the memory of earlier motions, which only
larger extrema wipe out."""

AFTER = 0.1
"""Share of the record that follows in the part: the samples that show the zero without
that memory."""

LATEST = 0.5
"""Largest share of a record that is used for the estimate."""

MOST = 20_000, 100_000
"""Most samples of the default part for the estimate: of the first share, and of its
extension until the inputs have covered their ranges."""

WINDOWS = 40
"""Number of stretches in which the error is compared with amplitude and rate."""

DISTINCT = 1.5
"""Least ratio of amplitudes or rates for which errors are reported separately."""

WORSE = 2.0
"""Least ratio to the error on the model's own record that raises a note."""

BEYOND = 0.1
"""Share of the recorded range by which an input must leave it to raise a note."""

ESTIMATES = 2
"""Number of further estimates of the state, each with the number of independent errors:
linear states that take up slow errors leave those that are more independent."""


class PartError(BaseModel):
    """RMS error (unit of the outputs) over stretches of similar amplitude or rate.

    ``kind`` is "amplitude", the range of the input within a stretch, or "rate", the rms
    value of its slope; in these stretches it lies between ``low`` and ``high``.
    """

    kind: str
    low: float
    high: float
    unit: str
    rmse: float


class RecordCheck(BaseModel):
    """Error of a model on one record.

    ``estimated`` and ``judged`` are samples, first and one past the last: the part from
    which the state before the record and the ``zero`` of each output were estimated,
    and the part over which the errors count. ``before`` are the levels of each input
    over which the stage is assumed to have moved before the record. ``rmse``,
    ``largest`` and ``zero`` are in ``unit``; ``rmse`` is None if the model diverges.
    ``times_fit`` is the ratio of ``rmse`` to the error on the model's own record, if
    that is known. ``by_input`` are the errors by amplitude and rate.
    """

    record: str
    rate_Hz: float  # noqa: N815
    estimated: tuple[int, int]
    judged: tuple[int, int]
    before: list[list[float]]
    zero: list[float]
    unit: str
    rmse: float | None
    largest: float | None
    percent_of_span: float | None
    times_fit: float | None
    by_input: list[PartError]


class ValidationReport(BaseModel):
    """Errors of a model on other records, the content of ``validation.json``.

    ``alarms`` speak against any use of the model on the stage of these records.
    """

    records: list[RecordCheck]
    alarms: list[str]
    notes: list[str]


@dataclass(frozen=True)
class Validation:
    """A model validated on ``records``, with its ``runs`` [samples, p] over them.

    ``about`` is the origin of the model, extended by the names of these records, the
    alarms, and an error bound that also holds for these records.
    """

    system: System
    about: About
    report: ValidationReport
    records: tuple[Record, ...]
    runs: tuple[np.ndarray, ...]


def validate(
    system: System,
    about: About,
    records: Record | Sequence[Record],
    *,
    estimate: slice | None = None,
) -> Validation:
    """Validate ``system`` by its free runs over other ``records`` of its stage.

    The state before each record, and the zero of its sensor, are estimated on the
    samples ``estimate``; errors count over the samples after it. By default it is the
    first fifth of the record, at most 20 000 samples. It is extended until a tenth of
    the record after the input has covered 90 % of its range, to at most half of the
    record and 100 000 samples. The state is that after a slow motion from rest over the
    three levels of the input with the least error. No parameter of the model changes.

    Raises ValueError if there is no record, for units that cannot be converted to those
    of the model, another sampling rate, an ``estimate`` that leaves no samples for the
    errors, and a model that does not take the inputs of the records.
    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    if not records:
        raise ValueError("there is no record to validate the model on")
    rate = _rate(system, about)
    records = tuple(_as_of_model(record, about, rate) for record in records)
    found = [_judged(system, about, record, estimate) for record in records]
    alarms, notes = (
        [f"{one.check.record}: {text}" for one in found for text in getattr(one, kind)]
        for kind in ("alarms", "notes")
    )
    bounds = [about.error_bound, *(one.bound for one in found)]
    known = [bound for bound in bounds if bound is not None]
    changed = {
        "checked": [*about.checked, *(record.source for record in records)],
        "unsafe": [*about.unsafe, *alarms],
        "error_bound": joined(known) if known else None,
    }
    checks = [one.check for one in found]
    return Validation(
        system,
        about.model_copy(update=changed),
        ValidationReport(records=checks, alarms=alarms, notes=notes),
        records,
        tuple(one.run for one in found),
    )


def _rate(system: System, about: About) -> float | None:
    """Return the rate of the model (Hz), None if its parts have none or several."""
    if about.rate_Hz is not None:
        return about.rate_Hz
    with suppress(ValueError):
        return 1.0 / sample_time(system)
    return None


def _as_of_model(record: Record, about: About, rate: float | None) -> Record:
    """Return ``record`` in the units of the model, which runs at ``rate`` (Hz).

    Raises ValueError for units that cannot be converted, and for another rate.
    """
    if rate is not None and not np.isclose(1.0 / record.dt, rate, rtol=1e-3):
        raise ValueError(
            f"{record.source} is sampled at {1.0 / record.dt:.6g} Hz, and the model "
            f"was made for {rate:.6g} Hz: resample the record (--resample "
            f"{rate:.6g}), or fit a model at its rate"
        )
    sides = [
        [
            unit
            for name, unit in about.units.items()
            if name.partition(" ")[0] == side and unit
        ]
        for side in ("input", "output")
    ]
    units = (record.input_units, record.output_units)
    wanted = [own or given for own, given in zip(sides, units, strict=True)]
    return record.in_units(*wanted)


class _Judged(NamedTuple):
    check: RecordCheck
    run: np.ndarray
    bound: ErrorBound | None
    alarms: list[str]
    notes: list[str]


def _judged(
    system: System, about: About, record: Record, estimate: slice | None
) -> _Judged:
    """Return the check of ``record``."""
    part = _part(record, estimate)
    rest = slice(part.stop, record.samples)
    inputs = _signals(system, record)
    start, run, zero = start_of(
        system, inputs, record.outputs, part, _ranges(inputs, about), ESTIMATES
    )
    run = np.where(np.abs(run) < LARGEST, run, np.nan)
    diverged = not np.all(np.isfinite(run))
    error = (run - record.outputs)[rest]
    each = np.sqrt(np.mean(error**2, axis=0))
    rmse = float(np.sqrt(np.mean(each**2)))
    own = np.sqrt(np.mean(np.square(about.residual_rms))) if about.residual_rms else 0.0
    check = RecordCheck(
        record=record.source,
        rate_Hz=1.0 / record.dt,
        estimated=(part.start, part.stop),
        judged=(rest.start, rest.stop),
        before=np.asarray(start.levels).reshape(len(start.levels), -1).T.tolist(),
        zero=[0.0 if diverged else float(z) for z in zero],
        unit=record.output_unit,
        rmse=None if diverged else rmse,
        largest=None if diverged else float(np.max(np.abs(error))),
        percent_of_span=None if diverged else 100.0 * rmse / float(record.spans.max()),
        times_fit=None if diverged or own == 0.0 else rmse / float(own),
        by_input=[] if diverged else _by_input(record, error, rest),
    )
    if diverged:
        text = "the model diverges on this record: choose another model"
        return _Judged(check, run, None, [text], [])
    faults = model_faults([record], [run], rest)
    shares = unexplained_shares(
        *(
            excited_columns(record, each)[rest]
            for each in (run - record.outputs, record.outputs)
        )
    )
    known = about.residual_rms if len(about.residual_rms) == len(each) else [0.0]
    fitted = np.array(known)
    times = np.where(fitted > 0.0, each / np.where(fitted > 0.0, fitted, 1.0), np.nan)
    alarms = [
        *_error_alarms(shares, times, about),
        *faults.alarms,
        *faults.warnings,
    ]
    notes = [*([] if alarms else _worse(check)), *_beyond(about, record)]
    return _Judged(check, run, faults.bound, alarms, notes)


def _part(record: Record, estimate: slice | None) -> slice:
    """Return the samples on which state and zero are estimated.

    Raises ValueError if ``estimate`` leaves no samples for the errors.
    """
    samples = record.samples
    if estimate is None:
        return default_part(record)
    start, stop = estimate.start or 0, estimate.stop
    if stop is None or not 0 <= start < stop < samples:
        raise ValueError(
            f"estimate is {start}:{stop}; it must lie in 0:{samples - 1}, the samples "
            f"of {record.source}, and leave samples for the errors"
        )
    return slice(start, stop)


def default_part(record: Record) -> slice:
    """Return the samples from which state and zero are estimated by default."""
    first, last = (
        min(most, max(1, round(share * record.samples)))
        for most, share in zip(MOST, (SHARE, LATEST), strict=True)
    )
    settled = first_covering(record.inputs, COVERED) + round(AFTER * record.samples)
    return slice(0, max(first, min(last, settled)))


def _signals(system: System, record: Record) -> np.ndarray:
    """Return the inputs as the model takes them, [samples] or [samples, m].

    Raises ValueError for a model of other inputs or outputs.
    """
    columns = record.inputs.shape[1]
    choices = [record.inputs[:, 0], record.inputs] if columns == 1 else [record.inputs]
    for inputs in choices:
        first = jnp.asarray(inputs[0])
        if not accepts(system, first):
            continue
        output = eqx.filter_eval_shape(rest_output, system, first)
        if math.prod(output.shape) != record.outputs.shape[1]:
            raise ValueError(
                f"the model has {math.prod(output.shape)} outputs and {record.source} "
                f"{record.outputs.shape[1]}: name the columns of its outputs (--output)"
            )
        return inputs
    raise ValueError(
        f"the model does not take the {columns} input columns of {record.source} "
        "(--input)"
    )


def _ranges(inputs: np.ndarray, about: About) -> np.ndarray:
    """Return the ends [2] or [2, m] of the range of record and model together."""
    low, high = np.min(inputs, axis=0), np.max(inputs, axis=0)
    if len(about.input_ranges) == np.size(low):
        known = np.asarray(about.input_ranges).T.reshape(2, *np.shape(low))
        low, high = np.minimum(low, known[0]), np.maximum(high, known[1])
    return np.stack([low, high])


def _by_input(record: Record, error: np.ndarray, part: slice) -> list[PartError]:
    """Return the errors by amplitude and rate of the first input, in thirds."""
    drive = record.inputs[part, 0]
    size = max(2, len(drive) // WINDOWS)
    count = len(drive) // size
    windows = drive[: count * size].reshape(count, size)
    squares = np.mean(error[: count * size].reshape(count, -1) ** 2, axis=1)
    found = []
    for kind, values, unit in (
        ("amplitude", np.ptp(windows, axis=1), record.input_unit),
        (
            "rate",
            np.sqrt(np.mean(np.diff(windows, axis=1) ** 2, axis=1)) / record.dt,
            f"{record.input_unit}/s",
        ),
    ):
        groups = np.array_split(np.argsort(values, kind="stable"), 3)
        ends = [np.median(values[group]) for group in (groups[0], groups[-1])]
        if not ends[1] > DISTINCT * ends[0]:
            continue
        found += [
            PartError(
                kind=kind,
                low=float(values[group].min()),
                high=float(values[group].max()),
                unit=unit,
                rmse=float(np.sqrt(np.mean(squares[group]))),
            )
            for group in groups
        ]
    return found


def _error_alarms(shares: np.ndarray, times: np.ndarray, about: About) -> Iterator[str]:
    """Yield an alarm for each output whose error is large.

    ``shares`` are the errors relative to the motions, ``times`` relative to those of
    the fit, NaN if these are not known. On a record of small motions an error as small
    as that of the fit raises no alarm.
    """
    for output, (share, ratio) in enumerate(zip(shares, times, strict=True)):
        if share <= POOR or ratio <= WORSE:
            continue
        compared = "" if np.isnan(ratio) else f" and {ratio:.3g} times that of the fit"
        yield (
            "the model does not hold on this record: its error"
            f"{of_output(output, shares.size)} is {100.0 * share:.0f} % of the motion"
            f"{compared}; it is a model of another stage "
            f"({about.record or 'its record is unknown'}), or stage, sensor or columns "
            "have changed: fit a model to this record"
        )


def _worse(check: RecordCheck) -> Iterator[str]:
    """Yield a note if the error is larger than on the record of the model."""
    if check.times_fit is not None and check.times_fit > WORSE:
        yield (
            f"the error is {check.times_fit:.3g} times that on the record of the "
            "model: fit a model to both records, or expect the error of feedforward "
            "to grow as much"
        )


def _beyond(about: About, record: Record) -> Iterator[str]:
    """Yield a note for each input that leaves the range of the model's record."""
    columns, units = record.inputs.T, record.input_units
    for (low, high), column, unit in zip(
        about.input_ranges, columns, units, strict=False
    ):
        slack = BEYOND * (high - low)
        least, most = float(column.min()), float(column.max())
        if least < low - slack or most > high + slack:
            yield (
                f"the input covers {least:.4g} to {most:.4g} {unit}, the "
                f"record of the model {low:.4g} to {high:.4g}: outside it the model "
                "extrapolates"
            )
