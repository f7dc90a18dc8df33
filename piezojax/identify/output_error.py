"""Fitting any System to a record by its free-run simulation error."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from pydantic import AliasChoices, BaseModel, Field

from .._types import ScalarLike
from ..paths import get, replace
from ..rollout import simulate
from ..space import Space, squash, unsquash
from ..system import System, rest_output
from .models import MODELS, REST_INPUT
from .record import Record

AS_GOOD = 1e-3
"""Starts whose mean square comes this close (as a share) to the best fit as well."""

POOR = 0.2
"""A validation error above this share of the output's deviation gives a warning."""

CYCLES = 3
"""Fewer full hysteresis cycles than this in the training part give a warning."""


class FittedParameter(BaseModel):
    """A fitted value and its standard error, in the parameter's own unit."""

    value: float
    standard_error: float | None


class FitError(BaseModel):
    """RMS of the free-run simulation error over a part of the record."""

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
    """A fitted plant, its report, the record and the simulated output (its unit)."""

    system: System
    report: FitReport
    record: Record
    simulated: np.ndarray
    train: slice
    validate: slice


def free_run(
    system: System, input: Float[Array, " n"], before: ScalarLike
) -> Float[Array, " n"]:
    """Return the output samples that ``system`` predicts from ``input`` alone.

    A plant maps u(k) to y(k+1), as in the loop; the first output is that at rest under
    ``before``, the input in force when the record begins.
    """
    _, outputs = simulate(system, input, system.init(before))
    first = rest_output(system, before)
    return jnp.concatenate([first[None], outputs[:-1]])


def _from_rest(system: System, input: Float[Array, " n"]) -> Float[Array, " n"]:
    """Free run from the rest point that the model itself carries."""
    return free_run(system, input, get(system, REST_INPUT))


def identify(
    record: Record,
    model: str = "coleman_hodgdon",
    *,
    train: slice | None = None,
    validate: slice | None = None,
    steps: int = 200,
) -> Fit:
    """Fit ``model`` (a name in MODELS) to ``record``.

    Levenberg-Marquardt with the forward Jacobian on the free-run error over ``train``
    (the first half if left out), from several starts at once; judged on ``validate``
    (the rest). Free-run means that the model sees the input alone, from the first
    sample on. Raises ValueError for an unknown model, an empty part, or when no start
    leads to a finite fit.
    """
    began = time.perf_counter()
    if model not in MODELS:
        raise ValueError(f"model {model!r} is unknown; there are {', '.join(MODELS)}")
    train, validate = _parts(record, train, validate)
    structure = MODELS[model](record)
    input, output = jnp.asarray(record.input), jnp.asarray(record.output)
    unit, losses = _least_squares(
        structure.system,
        structure.space,
        jnp.asarray(structure.starts),
        input[: train.stop],
        output[: train.stop],
        train.start,
        steps,
    )
    losses = np.where(np.isfinite(losses), losses, np.inf)
    best = int(np.argmin(losses))
    if not np.isfinite(losses[best]):
        raise ValueError(
            f"no start of {model} led to a finite simulation of the record"
        )
    system = structure.space.put(structure.system, unit[best])
    simulated = np.asarray(jax.jit(_from_rest)(system, input))
    error = simulated - record.output
    values = structure.space.from_unit(unit[best])
    deviations = _standard_errors(structure, values, input, train, error)
    report = FitReport(
        model=model,
        parameters={
            path: FittedParameter(value=float(value), standard_error=deviation)
            for path, value, deviation in zip(
                structure.space.paths, values, deviations, strict=True
            )
        },
        train=_fit_error(error[train], record),
        validation=_fit_error(error[validate], record),
        warnings=[
            *_record_warnings(record, train, validate),
            *_fit_warnings(structure.space, np.asarray(unit), losses, deviations),
            *_error_warnings(error[validate], record.output[validate]),
        ],
        wall_s=time.perf_counter() - began,
    )
    return Fit(system, report, record, simulated, train, validate)


def _parts(
    record: Record, train: slice | None, validate: slice | None
) -> tuple[slice, slice]:
    samples = record.input.size
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


@eqx.filter_jit
def _least_squares(
    system: System,
    space: Space,
    starts: Float[Array, "starts n"],
    input: Array,
    output: Array,
    skip: int,
    steps: int,
) -> tuple[Float[Array, "starts n"], Float[Array, " starts"]]:
    def residuals(free, _):
        error = _from_rest(space.put(system, squash(free)), input) - output
        # A start that diverges must not poison the others of its batch.
        return jnp.where(jnp.isfinite(error), error, 1e6)[skip:]

    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)

    def one(start):
        solution = optx.least_squares(
            residuals,
            solver,
            unsquash(start),
            options={"jac": "fwd"},
            max_steps=steps,
            throw=False,
        )
        return squash(solution.value), jnp.mean(residuals(solution.value, None) ** 2)

    return jax.vmap(one)(jnp.clip(starts, 1e-6, 1.0 - 1e-6))


def _standard_errors(structure, values, input, train, error) -> Sequence[float | None]:
    """Gauss-Newton covariance s^2 (J'J)^-1 at the fit, white residuals assumed."""

    def predicted(values):
        named = dict(zip(structure.space.paths, values, strict=True))
        return _from_rest(replace(structure.system, named), input[: train.stop])

    jacobian = np.asarray(jax.jit(jax.jacfwd(predicted))(values))[train.start :]
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    freedom = max(jacobian.shape[0] - jacobian.shape[1], 1)
    variance = float(np.sum(error[train] ** 2)) / freedom
    try:
        covariance = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) * variance
    except np.linalg.LinAlgError:
        return [None] * len(structure.space.paths)
    diagonal = np.diag(covariance) / scale**2
    return [float(np.sqrt(d)) if np.isfinite(d) and d >= 0 else None for d in diagonal]


def _fit_error(error: np.ndarray, record: Record) -> FitError:
    rmse = float(np.sqrt(np.mean(error**2)))
    return FitError(
        rmse=rmse,
        rmse_percent_of_span=100.0 * rmse / record.span,
        unit=record.output_unit,
    )


def cycles(input: np.ndarray) -> int:
    """Return the number of full cycles of ``input`` through its mid-level."""
    above = input > 0.5 * (input.min() + input.max())
    return int(np.sum(~above[:-1] & above[1:]))


def _record_warnings(record: Record, train: slice, validate: slice) -> list[str]:
    found = []
    count = cycles(record.input[train])
    if count < CYCLES:
        found.append(
            f"{count} full hysteresis cycles in the training part; "
            f"{CYCLES} or more separate the loop from its initial loading"
        )
    spectrum = np.abs(np.fft.rfft(record.input[train] - np.mean(record.input[train])))
    if np.sum(spectrum > 0.05 * spectrum.max()) <= 5:
        found.append(
            "the input has essentially one frequency: hysteresis and linear lag are "
            "told apart by the shape of the loop alone, and the model says nothing "
            "about other frequencies"
        )
    if validate.start < train.stop and train.start < validate.stop:
        found.append(
            "the validation part shares samples with the training part: "
            "its error is no measure of prediction"
        )
    return found


def _fit_warnings(
    space: Space,
    units: np.ndarray,
    losses: np.ndarray,
    deviations: Sequence[float | None],
) -> list[str]:
    found = []
    best = int(np.argmin(losses))
    as_good = units[losses <= losses[best] * (1.0 + AS_GOOD) + 1e-30]
    spread = np.ptp(as_good, axis=0)
    for i, path in enumerate(space.paths):
        if units[best, i] < 1e-3 or units[best, i] > 1.0 - 1e-3:
            found.append(f"{path} lies at the edge of its bounds")
        if deviations[i] is None:
            found.append(f"{path} is not determined by this record")
        elif spread[i] > AS_GOOD:
            values = [float(space.from_unit(jnp.asarray(u))[i]) for u in as_good]
            found.append(
                f"{path} is ambiguous: values from {min(values):.4g} to "
                f"{max(values):.4g} fit equally well"
            )
    return found


def _error_warnings(error: np.ndarray, output: np.ndarray) -> list[str]:
    share = float(np.sqrt(np.mean(error**2)) / max(np.std(output), 1e-30))
    if share <= POOR:
        return []
    return [
        f"the model explains little: its validation error is {100.0 * share:.0f} % of "
        "the output's own deviation"
    ]
