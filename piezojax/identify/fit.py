"""From records to a plant: the verb ``identify``, its report, its warnings."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from pydantic import AliasChoices, BaseModel, Field

from .._types import as_array
from ..paths import parameters
from ..progress import Progress
from ..system import System
from .checks import record_warnings
from .models import DEFAULT, structure
from .output_error import Optimum, from_rest, output_error
from .record import Record
from .structure import REST_INPUT

AS_GOOD = 1e-3
"""Starts whose mean square comes this close (as a share) to the best fit as well."""

POOR = 0.2
"""A validation error above this share of the output's deviation gives a warning."""


class FittedParameter(BaseModel):
    """A fitted value and its standard error, in the parameter's own unit."""

    value: float
    standard_error: float | None


class FitError(BaseModel):
    """RMS of the free-run simulation error over a part of the records."""

    rmse: float
    rmse_percent_of_span: float
    unit: str


class FitReport(BaseModel):
    """What a fit found: the content of ``fit.json``."""

    model: str
    parameters: dict[str, FittedParameter]
    train: FitError
    validation: FitError = Field(
        serialization_alias="validate",
        validation_alias=AliasChoices("validate", "validation"),
    )
    warnings: list[str]
    wall_s: float


@dataclass(frozen=True)
class Fit:
    """A fitted plant, its report, the records and the simulated outputs (their unit).

    ``system`` holds what was in force before the first record.
    """

    system: System
    report: FitReport
    records: tuple[Record, ...]
    simulations: tuple[np.ndarray, ...]
    train: slice
    validate: slice

    @property
    def record(self) -> Record:
        """The first record."""
        return self.records[0]

    @property
    def simulated(self) -> np.ndarray:
        """The simulated output of the first record."""
        return self.simulations[0]


def identify(
    records: Record | Sequence[Record],
    model: str = DEFAULT,
    *,
    train: slice | None = None,
    validate: slice | None = None,
    steps: int = 200,
    progress: Progress | None = None,
) -> Fit:
    """Fit ``model`` to one record or to several with the same sample time.

    ``model`` is a chain of parts such as ``"prandtl_ishlinskii+logarithmic_creep+lag"``
    (see ``identify.PARTS``). Fitted by ``output_error`` over the samples ``train`` of
    each record (its first half if left out), judged on ``validate`` (the rest). Raises
    ValueError for an unknown model, an empty part, records that do not go together, or
    when no start leads to a finite fit.
    """
    began = time.perf_counter()
    records = (records,) if isinstance(records, Record) else tuple(records)
    _check_together(records)
    train, validate = _parts(min(r.samples for r in records), train, validate)
    # Bounds and starts, too, must not see what the fit is judged on.
    seen = [record.until(train.stop) for record in records]
    shape = structure(model, max(seen, key=lambda record: record.span))
    optimum = output_error(shape, records, train, steps=steps, progress=progress)
    problem = optimum.problem
    systems = [
        shape.space.put(shape.system, as_array(optimum.units[0][row]))
        for row in np.asarray(problem.which)
    ]
    run = jax.jit(from_rest)
    simulations = tuple(
        np.asarray(run(system, as_array(record.input)))
        for system, record in zip(systems, records, strict=True)
    )
    report = FitReport(
        model=model,
        parameters={
            name: FittedParameter(value=float(value), standard_error=deviation)
            for name, value, deviation in zip(
                optimum.names, optimum.values, optimum.deviations, strict=True
            )
        },
        train=_fit_error(records, simulations, train),
        validation=_fit_error(records, simulations, validate),
        warnings=[
            *(
                f"{record.source}: {text}" if len(records) > 1 else text
                for record in records
                for text in record_warnings(
                    record,
                    train,
                    validate,
                    order=shape.order,
                    hysteresis=REST_INPUT in parameters(shape.system),
                )
            ),
            *_fit_warnings(optimum, steps),
            *_error_warnings(records, simulations, validate),
        ],
        wall_s=time.perf_counter() - began,
    )
    return Fit(systems[0], report, records, simulations, train, validate)


def _check_together(records: tuple[Record, ...]) -> None:
    if not records:
        raise ValueError("no record to fit a model to")
    for record in records[1:]:
        if not np.isclose(record.dt, records[0].dt, rtol=1e-6, atol=0.0):
            raise ValueError(
                f"{record.source} has the sample time {record.dt:g} s and "
                f"{records[0].source} {records[0].dt:g} s; they must be the same"
            )
        for side in ("input_units", "output_units"):
            if getattr(record, side) != getattr(records[0], side):
                raise ValueError(
                    f"{record.source} has the {side.replace('_', ' ')} "
                    f"{getattr(record, side)} and {records[0].source} "
                    f"{getattr(records[0], side)}; they must be the same"
                )


def _parts(
    samples: int, train: slice | None, validate: slice | None
) -> tuple[slice, slice]:
    train = _closed(train or slice(0, samples // 2), samples)
    validate = _closed(validate or slice(min(train.stop, samples), samples), samples)
    for name, part in (("train", train), ("validate", validate)):
        if not 0 <= part.start < part.stop <= samples:
            raise ValueError(
                f"{name} is {part.start}:{part.stop}; "
                f"it must lie in 0:{samples} and hold a sample"
            )
    return train, validate


def _closed(part: slice, samples: int) -> slice:
    stop = samples if part.stop is None else part.stop
    return slice(part.start or 0, stop)


def _errors(
    records: Sequence[Record], simulations: Sequence[np.ndarray], part: slice
) -> np.ndarray:
    return np.concatenate(
        [(s - r.output)[part] for r, s in zip(records, simulations, strict=True)]
    )


def _fit_error(
    records: Sequence[Record], simulations: Sequence[np.ndarray], part: slice
) -> FitError:
    rmse = float(np.sqrt(np.mean(_errors(records, simulations, part) ** 2)))
    return FitError(
        rmse=rmse,
        rmse_percent_of_span=100.0 * rmse / max(r.span for r in records),
        unit=records[0].output_unit,
    )


def _fit_warnings(optimum: Optimum, steps: int) -> list[str]:
    found = []
    if not optimum.finished:
        found.append(
            f"the fit was still getting better when its {steps} steps were used up"
        )
    as_good = optimum.units[optimum.losses <= optimum.losses[0] * (1.0 + AS_GOOD)]
    spread = np.ptp(as_good, axis=0)
    for i, name in enumerate(optimum.names):
        place = optimum.units[0, i]
        if place < 1e-3 or place > 1.0 - 1e-3:
            found.append(f"{name} lies at the edge of its bounds")
        if optimum.deviations[i] is None:
            found.append(f"{name} is not determined by this record")
        elif spread[i] > AS_GOOD:
            found.append(
                f"{name} is ambiguous: other values fit equally well, over "
                f"{100.0 * spread[i]:.2g} % of its range"
            )
    return found


def _error_warnings(
    records: Sequence[Record], simulations: Sequence[np.ndarray], part: slice
) -> list[str]:
    error = _errors(records, simulations, part)
    deviation = np.std(np.concatenate([r.output[part] for r in records]))
    share = float(np.sqrt(np.mean(error**2)) / max(deviation, 1e-30))
    if share <= POOR:
        return []
    return [
        f"the model explains little: its validation error is {100.0 * share:.0f} % of "
        "the output's own deviation"
    ]
