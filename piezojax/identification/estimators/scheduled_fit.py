"""Fit of amplitude-scheduled models to records at several drive levels."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...core.arrays import as_array
from ...core.progress import Progress
from ...dynamics import AmplitudeScheduled, StateSpace
from ..records.record import Record
from ..records.resample import whole_periods
from .estimate import Estimate, FittedParameter, LinearDetail, Options
from .frequency import empirical_response
from .linear import Centre, steady_run
from .response_fit import STEPS, fit_response, refined

MODEL = "amplitude_scheduled"

SAME_LEVEL = 0.1
"""Largest relative difference of the rms inputs of records of one level."""

OFFSET = 0.1
"""Mean of an input, as a share of its standard deviation, above which a note warns."""


def fit_scheduled(
    levels: Sequence[Sequence[Record]],
    start: StateSpace,
    *,
    time_constant: float = 0.1,
    steps: int = STEPS,
    ahead: bool = False,
) -> AmplitudeScheduled:
    """Fit dynamics scheduled by drive level to periodic records, grouped by level.

    The model of each level is ``refined`` from the common ``start``, so that modes
    correspond and can be interpolated between two levels. The level is the rms of the
    inputs of its records; ``time_constant`` (s) is that of the level's measurement in
    the model. With ``ahead`` the models, and ``start``, map u(k) to y(k+1), otherwise
    to y(k). Levels may come in any order. Raises ValueError as ``empirical_response``
    and AmplitudeScheduled do.
    """
    drive = [_rms(records) for records in levels]
    rising = np.argsort(drive)
    measured = [empirical_response(levels[i]) for i in rising]
    measured = [one.ahead() for one in measured] if ahead else measured
    models = [refined(start, one, steps)[0] for one in measured]
    return AmplitudeScheduled(
        tuple(models), tuple(drive[i] for i in rising), time_constant
    )


def by_amplitude(
    model: str,
    records: Sequence[Record],
    train: slice,
    options: Options,
    progress: Progress,
) -> Estimate:
    """Fit dynamics scheduled by drive level to periodic records of several levels.

    Records whose rms inputs differ by less than SAME_LEVEL share a level. The common
    start is a linear model of ``options.order`` states, fitted to all records. Each
    record is weighted by the inverse of its mean-square input, so that equal relative
    errors count alike. The model maps u(k) to y(k+1), as a loop expects of its plant:
    it is fitted to the transfer matrix one sample ahead. Raises ValueError for one
    channel, for a single level, and as ``empirical_response`` and ``fit_response`` do.
    """
    if records[0].single:
        raise ValueError(
            f"{model} is for records of several inputs or outputs; these have one of "
            "each: name their columns (--input, --output)"
        )
    centres = [Centre.of(record, train) for record in records]
    parts = [
        whole_periods(centre.removed(record), train)
        for record, centre in zip(records, centres, strict=True)
    ]
    levels = _levels(parts)
    progress.stage("measuring the transfer matrices")
    try:
        for level in levels:
            empirical_response(level)  # each level alone must determine it
    except ValueError as error:
        drives = ", ".join(f"{len(level)} at {_rms(level):.3g}" for level in levels)
        unit = records[0].input_unit
        raise ValueError(f"{error} (records by level: {drives} {unit} rms)") from None
    weights = [1.0 / float(np.mean(part.inputs**2)) for part in parts]
    measured = empirical_response(parts, weights)
    progress.stage(f"fitting {options.order} states to all levels")
    steps = min(options.steps, STEPS)
    start = fit_response(measured.ahead(), options.order, steps=steps)
    progress.stage(f"fitting them to each of {len(levels)} levels")
    system = fit_scheduled(levels, start.model, steps=steps, ahead=True)
    runs = tuple(
        _run(system, r.inputs - c.input, r.period or 0) + c.output
        for r, c in zip(records, centres, strict=True)
    )
    warnings = ["inputs and outputs are deviations from their means"]
    offsets = [
        np.max(np.abs(c.input) / np.maximum(p.inputs.std(axis=0), 1e-30))
        for c, p in zip(centres, parts, strict=True)
    ]
    if max(offsets) > OFFSET:
        warnings.append(
            "the inputs have a mean: the level of the model is their rms about it, and "
            "in a loop the level includes the mean of the drive"
        )
    named = {
        f"level {i}, {record_level:.4g} {records[0].input_unit} rms: largest pole "
        "modulus": FittedParameter(
            value=float(np.abs(one.poles()).max()), standard_error=None
        )
        for i, (one, record_level) in enumerate(
            zip(system.models, map(float, system.levels), strict=True)
        )
    }
    outputs, inputs = system.models[0].D.shape
    count = options.order * (inputs + outputs) * len(levels) + outputs
    return Estimate(
        system,
        runs,
        named,
        warnings,
        2 * options.order,
        linear=LinearDetail(
            start.model.delayed(), options.order, {"": start.singular_values}, measured
        ),
        count=count,
    )


def _run(
    model: AmplitudeScheduled, inputs: Float[np.ndarray, "n m"], period: int
) -> Float[np.ndarray, "n p"]:
    """Return the outputs of ``model`` at the times of ``inputs``.

    The model maps u(k) to y(k+1). It runs over one more period first, so that it has
    settled.
    """
    whole = np.concatenate([inputs[:period], inputs])
    return np.asarray(steady_run(model, as_array(whole), 0))[period - 1 : -1]


def _rms(records: Sequence[Record]) -> float:
    return float(np.sqrt(np.mean([np.mean(record.inputs**2) for record in records])))


def _levels(records: Sequence[Record]) -> list[list[Record]]:
    """Return the records by level, the lowest first.

    Raises ValueError if there is a single level.
    """
    ordered = sorted(records, key=lambda record: _rms([record]))
    levels = [[ordered[0]]]
    for record in ordered[1:]:
        if _rms([record]) > _rms(levels[-1]) * (1.0 + SAME_LEVEL):
            levels.append([])
        levels[-1].append(record)
    if len(levels) < 2:
        raise ValueError(
            f"all records have about one drive level, {_rms(ordered):.3g} "
            f"{records[0].input_unit} rms; {MODEL} needs records of two or more"
        )
    return levels
