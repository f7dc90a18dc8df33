"""Judgement of a saved model on other records of its stage."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import BaseModel

from ..core.about import About
from ..core.error_bound import ErrorBound
from ..core.rollout import simulate
from ..core.system import System, accepts
from .fit import POOR, unexplained_share
from .records.record import LARGEST, Record
from .residuals.bound import joined
from .residuals.report import model_faults

SHARE = 0.2
"""Part of a record, from its beginning, from which state and zero are estimated."""

MOST = 20_000
"""Most samples of that part, if it is not given."""

APPROACH = 2000
"""Samples of the assumed motion before a record."""

LEVELS = 9
"""Levels of the input tried for each of the two turning points of that motion."""

FINER = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Levels around the best ones, in steps of the first grid."""

WINDOWS = 40
"""Stretches in which the error is compared with amplitude and rate."""

DISTINCT = 1.5
"""Ratio of amplitudes or rates from which the errors at them are told apart."""

WORSE = 2.0
"""Factor over the error on the model's own record from which a note says so."""

BEYOND = 0.1
"""Share of the recorded range by which an input leaves it."""


class PartError(BaseModel):
    """RMS error (unit of the outputs) of the stretches with a ``kind`` of input.

    ``kind`` is "amplitude", the range of the input within a stretch, or "rate", the rms
    value of its slope; it lies between ``low`` and ``high``.
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
    and the part over which the errors count. ``before`` are the two levels of each
    input between which the stage is assumed to have moved before the record. ``rmse``,
    ``largest`` and ``zero`` are in ``unit``; ``rmse`` is None if the model diverges.
    ``times_fit`` is the ratio of ``rmse`` to the error on the model's own record, if
    that is known. ``by_input`` are the errors by amplitude and rate.
    """

    record: str
    rate_Hz: float  # noqa: N815
    estimated: tuple[int, int]
    judged: tuple[int, int]
    before: list[tuple[float, float]]
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
    """A model judged on ``records``, with its ``runs`` [samples, p] over them.

    ``about`` is the origin of the model with what these records add: their names, the
    alarms, and an error bound that also holds for them.
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
    """Judge ``system`` by its free runs over other ``records`` of its stage.

    The state before each record, and the zero of its sensor, are estimated on the
    samples ``estimate`` (by default the first fifth, at most 20 000 samples); the
    errors count over what follows. The state is that after a slow motion from rest
    between two levels of the input, the levels with the least error. No parameter of
    the model changes.

    Raises ValueError if there is no record, for units that cannot be converted to those
    of the model, another sampling rate, an ``estimate`` that leaves nothing to judge,
    and a model that does not take the inputs of the records.
    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    if not records:
        raise ValueError("no record to judge the model on")
    records = tuple(_as_of_model(record, about) for record in records)
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


def _as_of_model(record: Record, about: About) -> Record:
    """Return ``record`` in the units of the model.

    Raises ValueError for units that cannot be converted, and for another rate.
    """
    rate = 1.0 / record.dt
    if about.rate_Hz is not None and not np.isclose(rate, about.rate_Hz, rtol=1e-3):
        raise ValueError(
            f"{record.source} is sampled at {rate:.6g} Hz, and the model was made for "
            f"{about.rate_Hz:.6g} Hz: resample the record (--resample "
            f"{about.rate_Hz:.6g}), or fit a model at its rate"
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
    before = _levels_before(system, about, record, part)
    run = _runs(system, record, before[None])[0]
    zero = np.mean((record.outputs - run)[part], axis=0)
    diverged = not np.all(np.isfinite(run))
    run = run + zero
    error = (run - record.outputs)[rest]
    each = np.sqrt(np.mean(error**2, axis=0))
    rmse = float(np.sqrt(np.mean(each**2)))
    own = np.sqrt(np.mean(np.square(about.residual_rms))) if about.residual_rms else 0.0
    check = RecordCheck(
        record=record.source,
        rate_Hz=1.0 / record.dt,
        estimated=(part.start, part.stop),
        judged=(rest.start, rest.stop),
        before=[(float(a), float(b)) for a, b in before.T],
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
    share = unexplained_share(error, record.outputs[rest])
    alarms = [*_error_alarms(check, about, share), *faults.warnings]
    notes = [*([] if alarms else _worse(check)), *_beyond(about, record)]
    return _Judged(check, run, faults.bound, alarms, notes)


def _part(record: Record, estimate: slice | None) -> slice:
    """Return the samples from which to estimate; ValueError if none are left."""
    samples = record.samples
    if estimate is None:
        return slice(0, min(MOST, max(1, round(SHARE * samples))))
    start, stop = estimate.start or 0, estimate.stop
    if stop is None or not 0 <= start < stop < samples:
        raise ValueError(
            f"estimate is {start}:{stop}; it must lie in 0:{samples - 1}, the samples "
            f"of {record.source}, and leave samples to judge"
        )
    return slice(start, stop)


def _levels_before(
    system: System, about: About, record: Record, part: slice
) -> np.ndarray:
    """Return the two levels [2, m] of the inputs before the record that fit best."""
    low, high = (f(record.inputs, axis=0) for f in (np.min, np.max))
    if len(about.input_ranges) == low.size:
        ranges = np.asarray(about.input_ranges)
        low, high = np.minimum(low, ranges[:, 0]), np.maximum(high, ranges[:, 1])

    def best(candidates: np.ndarray) -> np.ndarray:
        runs = _runs(system, record, candidates, part.stop)
        # The zero is free: only the scatter of the error counts.
        scatter = np.var(record.outputs[part] - runs[:, part], axis=1).sum(axis=-1)
        return candidates[np.argmin(np.where(np.isfinite(scatter), scatter, np.inf))]

    grid = np.linspace(0.0, 1.0, LEVELS)
    shares = np.array([*product(grid, grid)])[:, :, None]
    first = np.broadcast_to(record.inputs[0], (1, 2, low.size))
    found = best(np.concatenate([first, low + shares * (high - low)]))
    around = np.array([*product(FINER, FINER)])[:, :, None] * (high - low) * grid[1]
    return best(np.clip(found + around, low, high))


def _runs(
    system: System, record: Record, levels: np.ndarray, stop: int | None = None
) -> np.ndarray:
    """Return the free runs [candidates, stop, p] after the ``levels``.

    Samples of a run that diverges are NaN.
    """
    inputs = jnp.asarray(record.inputs[:stop])
    single = inputs.shape[1] == 1 and accepts(system, inputs[0, 0])
    if not single and not accepts(system, inputs[0]):
        raise ValueError(
            f"the model does not take the {inputs.shape[1]} input columns of "
            f"{record.source} (--input)"
        )
    found = np.asarray(
        _all_runs(
            system, inputs[:, 0] if single else inputs, jnp.asarray(levels), single
        )
    )
    found = np.where(np.abs(found) < LARGEST, found, np.nan)
    found = found[..., None] if found.ndim == 2 else found
    if found.shape[-1] != record.outputs.shape[1]:
        raise ValueError(
            f"the model has {found.shape[-1]} outputs and {record.source} "
            f"{record.outputs.shape[1]}: name the columns of its outputs (--output)"
        )
    return found


@eqx.filter_jit
def _all_runs(
    system: System,
    inputs: Float[Array, " samples *m"],
    levels: Float[Array, " candidates 2 m"],
    single: bool,
) -> Array:
    """Return the outputs after a slow motion from rest over both ``levels``.

    A plant maps u(k) to y(k+1), as in ``free_run``.
    """
    half = 0.5 - 0.5 * jnp.cos(jnp.linspace(0.0, jnp.pi, APPROACH // 2))[:, None]

    def one(pair: Array) -> Array:
        pair = pair[:, 0] if single else pair
        way = half[:, 0] if single else half
        first = pair[0] + (pair[1] - pair[0]) * way
        second = pair[1] + (inputs[0] - pair[1]) * way
        _, outputs = simulate(
            system, jnp.concatenate([first, second, inputs]), system.init(pair[0])
        )
        begin = first.shape[0] + second.shape[0] - 1
        return outputs[begin : begin + inputs.shape[0]]

    return jax.vmap(one)(levels)


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


def _error_alarms(check: RecordCheck, about: About, share: float) -> Iterator[str]:
    """Yield an alarm if the error is large against the motion, and unexpected.

    A record of small motions may hold little but the error that the fit had too.
    """
    times = check.times_fit
    if share <= POOR or (times is not None and times <= WORSE):
        return
    compared = "" if times is None else f" and {times:.3g} times that of the fit"
    yield (
        f"the model does not hold on this record: its error is {100.0 * share:.0f} % "
        f"of the motion{compared}; it is a model of another stage "
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
    for (low, high), column in zip(about.input_ranges, record.inputs.T, strict=False):
        slack = BEYOND * (high - low)
        least, most = float(column.min()), float(column.max())
        if least < low - slack or most > high + slack:
            yield (
                f"the input covers {least:.4g} to {most:.4g} {record.input_unit}, the "
                f"record of the model {low:.4g} to {high:.4g}: outside it the model "
                "extrapolates"
            )
