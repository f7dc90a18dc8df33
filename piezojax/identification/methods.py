"""Methods of identification by name, with a common signature."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace as replace_record
from typing import NamedTuple

import numpy as np

from ..core.arrays import as_array
from ..core.paths import get, parameters, replace
from ..core.progress import Progress
from ..core.system import Affine, series
from ..hysteresis.model import hystereses
from .chain import OFFSET, SLEW, by_evidence, structure, unclear_step
from .closed_loop import LoopFit, is_closed, loop_fit
from .estimators.approach import BEFORE, without_before
from .estimators.estimate import Estimate, FittedParameter, Options, bound_warning
from .estimators.free_runs import free_runs
from .estimators.linear import by_frequency_response, by_subspace
from .estimators.model_bouc_wen import bouc_wen
from .estimators.model_preisach import PLAIN, RATE_DEPENDENT, preisach_with_lag
from .estimators.neural import fit_neural_state_space
from .estimators.output_error import Optimum, output_error
from .estimators.regression import instrumental_variables, least_squares
from .estimators.resonances import LinearDynamics
from .estimators.scheduled_fit import MODEL as SCHEDULED
from .estimators.scheduled_fit import by_amplitude
from .estimators.standard_errors import values_and_errors
from .estimators.steady_state import fit_structure, steady_response
from .estimators.structure import Structure
from .records.record import Record
from .records.resample import average_periods, resample, whole_periods
from .second_sight import fit_seen

EQUAL_LOSS = 1e-3
"""Relative excess of the mean square below which a fit equals the best one."""

AMBIGUOUS = 0.01
"""Spread of a parameter among equally good fits, as a share of its range, above which
to warn."""

INPUT_BEFORE, ZERO = "input before the record", "zero of"
"""Names of the input in force before a single record, and of the zero of the sensor in
one of several, with the record behind it."""

FITTED_AGAIN = (
    "free run from the measured input, near the known plant; biased towards -1 / "
    "controller where noise makes up most of the input"
)
"""Text on the fit of a known plant to records of a closed loop."""

Records = Sequence[Record]


def _by_output_error(
    model: str, records: Records, train: slice, options: Options, progress: Progress
) -> Estimate:
    shown: LinearDynamics | None = None
    if options.known is None and is_closed(records, options):
        found = loop_fit(model, records, train, options, progress)
    elif len(records) > 1 and options.known is None and options.dynamics is None:
        optimum, (shape, shown, _) = fit_seen(
            model, records, train, options.steps, progress, options.begun
        )
        found = LoopFit(optimum, optimum.system, shape, "", [])
    else:
        text = ""
        if options.known is not None:
            shape = options.known.structure(records)
            text = is_closed(records, options) * FITTED_AGAIN
        else:
            first, *beside = by_evidence(records, train)
            shape = structure(model, first, options.dynamics, beside=beside)
        optimum = output_error(
            shape,
            records,
            train,
            steps=options.steps,
            progress=progress,
            own_starts=options.known is not None,
        )
        found = LoopFit(optimum, optimum.system, shape, text, [])
    system, optimum, shape = found.system, found.optimum, found.shape
    # A stage whose plant is known was moved before the record; weights need its state.
    moved = options.known is not None or optimum.weights is not None
    several = moved or len(records) > 1
    renamed = {BEFORE: INPUT_BEFORE}
    named = {
        renamed.get(name, name.removeprefix(found.inside)): FittedParameter(
            value=float(value), standard_error=error
        )
        for name, value, error in zip(
            optimum.problem.space.paths, *values_and_errors(optimum), strict=True
        )
    }
    warnings = _optimum_warnings(optimum, named, shape, options.steps)
    warnings += slew_warning(named, by_evidence(records, train))
    if not found.scatter_known:
        named = {
            name: one.model_copy(update={"standard_error": None})
            for name, one in named.items()
        }
    runs, zeros = free_runs(system, records, train, own_starts=several)
    system = without_before(system)
    if INPUT_BEFORE in named:
        # Only parameters of the stage have errors, from which other stages are drawn.
        value = named.pop(INPUT_BEFORE).value
        named[INPUT_BEFORE] = FittedParameter(value=value, standard_error=None)
    if several:
        named |= {
            f"{ZERO} {record.source or i}": FittedParameter(
                value=zero, standard_error=None
            )
            for i, (record, zero) in enumerate(zip(records, zeros, strict=True))
        }
        system = replace(system, {OFFSET: get(system, OFFSET) + zeros[0]})
    elif found.inside and OFFSET in named:
        # An integrator in the loop hides the offset of the stage.
        zero = float(np.mean((records[0].output - runs[0][:, 0])[train]))
        value = float(get(system, OFFSET)) + zero
        system, runs = replace(system, {OFFSET: value}), (runs[0] + zero,)
        named[OFFSET] = FittedParameter(value=value, standard_error=None)
    outside = 0 if optimum.weights is None else round(optimum.weights.freedom)
    return Estimate(
        system,
        runs,
        named,
        [*found.warnings, *warnings],
        shape.order,
        bool(hystereses(shape.system)),
        count=len(named) + outside,
        closed_loop=found.text,
        shown=shown,
    )


def _optimum_warnings(
    optimum: Optimum,
    fitted: Mapping[str, FittedParameter],
    shape: Structure,
    steps: int,
) -> list[str]:
    found = []
    # The narrow bounds of shown dynamics come from the record: no warning at a bound.
    shown = shape.dynamics if shape.whitening else ()
    if not optimum.finished:
        found.append(f"the fit had not converged after its {steps} steps")
    equal = optimum.units[optimum.losses <= optimum.losses[0] * (1.0 + EQUAL_LOSS)]
    spread = np.ptp(equal, axis=0)
    for i, name in enumerate(fitted):
        if name not in shown:
            found += bound_warning(name, optimum.units[0, i])
        if name == INPUT_BEFORE:
            continue  # it is no parameter of the stage
        if fitted[name].standard_error is None:
            found.append(f"{name} is not determined by this record")
        elif spread[i] > AMBIGUOUS:
            found.append(
                f"{name} is ambiguous: other values fit equally well, over "
                f"{100.0 * spread[i]:.2g} % of its range"
            )
    return [*found, *weights_warning(optimum)]


def weights_warning(optimum: Optimum) -> list[str]:
    """Return a warning if the records do not determine all weights of a hysteresis."""
    weights = optimum.weights
    if weights is None or weights.freedom > weights.above.size - 0.5:
        return []
    return [
        f"the records determine {weights.freedom:.0f} of the {weights.above.size} "
        "weights of the hysteresis, the others follow from their neighbours: errors on "
        "motions of another kind may be several times those of the fit. Validate the "
        "model on another record"
    ]


def slew_warning(fitted: Mapping[str, FittedParameter], records: Records) -> list[str]:
    """Return a warning if the ``records``, sorted ``by_evidence``, only hint at it."""
    first, *beside = records
    if SLEW not in fitted or not unclear_step(first, beside):
        return []
    rate = f"{fitted[SLEW].value:.3g} {first.input_unit}/s"
    return [
        f"the slew rate {SLEW}, {rate}, is a guess: so few steps do not tell it from a "
        "delay. Expect larger errors after jumps, or add a record with five steps or "
        "more of the size that the stage will meet"
    ]


def _by_regression(estimator: Callable) -> Callable[..., Estimate]:
    """Return the method that fits ``HystereticARMA``, (3.32), by ``estimator``."""

    def estimate(model, records, train, options, progress) -> Estimate:
        del model, options
        record = _single(records)
        progress.stage("searching for the parameter c of the hysteresis")
        found = estimator(record, train=train)
        errors = parameters(found.standard_errors)
        named = {
            path: FittedParameter(
                value=float(value),
                standard_error=float(errors[path])
                if np.isfinite(errors[path])
                else None,
            )
            for path, value in parameters(found.model).items()
            if path != "rest_input"
        }
        runs, _ = free_runs(found.model, [record], train)
        return Estimate(found.model, runs, named, [], len(named) - 2, True)

    return estimate


def _by_steady_state(
    model: str, records: Records, train: slice, options: Options, progress: Progress
) -> Estimate:
    record = _single(records)
    periods = whole_periods(record, train)
    period = record.period or 0
    # The first period holds the transient; a single period is used as it is.
    one = average_periods(periods, skip=int(periods.samples > period))
    factor = options.oversample if model == "bouc_wen" else 1
    fine = resample(one, factor)
    progress.stage(f"fitting {model} to a period of {fine.samples} samples")
    if model == "bouc_wen":
        system, _ = fit_structure(bouc_wen(fine), fine, steps=options.steps)
    else:
        system = fit_neural_state_space(fine, options.order, steps=options.steps)
    inputs = fine.input if fine.inputs.shape[1] == 1 else fine.inputs
    response = np.asarray(steady_response(system, as_array(inputs), fine.samples))
    response = response.reshape(fine.samples, -1)[::factor]
    phase = (np.arange(record.samples) - train.start) % period
    named = {
        path: FittedParameter(value=float(value), standard_error=None)
        for path, value in parameters(system).items()
        if np.ndim(value) == 0
    }
    warnings = [
        f"the model runs at {1.0 / fine.dt:g} Hz and takes the mean of the input over "
        "each sample: see identification.resample"
    ]
    count = sum(int(np.size(value)) for value in parameters(system).values())
    return Estimate(system, (response[phase],), named, warnings, count=count)


def _by_nonnegative_least_squares(
    model: str, records: Records, train: slice, options: Options, progress: Progress
) -> Estimate:
    del options
    record = _single(records)
    progress.stage(f"searching for the lag behind the {model} model")
    # The weights are nonnegative: for a falling output the chain inverts the sign.
    x, y = record.input[train], record.output[train]
    sign = float(np.sign(np.cov(x, y)[0, 1])) or 1.0
    found = preisach_with_lag(
        replace_record(record, outputs=sign * record.outputs), train, model
    )
    system = found.system
    if sign < 0.0:
        parts = dict(zip(system.names, system.parts, strict=True))
        system = series(**parts, calibration=Affine(-1.0))
    named = {
        name: FittedParameter(value=value, standard_error=deviation)
        for (name, value), deviation in zip(
            found.values.items(), found.deviations, strict=True
        )
    }
    runs, _ = free_runs(system, [record], train)
    return Estimate(system, runs, named, found.warnings, 1, True)


def _single(records: Records) -> Record:
    if len(records) != 1:
        raise ValueError(f"{len(records)} records; this method takes one")
    return records[0]


class Method(NamedTuple):
    """Summary, names of the ``models`` (none: chains of parts) and fit of a method.

    ``uses`` are the numbers of Options that change the fit, and ``closed_loop`` tells
    whether it takes the approaches to a closed loop. With ``in_turn`` each record
    drives one input of the model, in the order of the records.
    """

    summary: str
    models: tuple[str, ...]
    estimate: Callable[[str, Records, slice, Options, Progress], Estimate]
    uses: tuple[str, ...] = ()
    closed_loop: bool = False
    in_turn: bool = False


METHODS: dict[str, Method] = {
    "output_error": Method(
        "Levenberg-Marquardt on the free-run error",
        (),
        _by_output_error,
        uses=("steps",),
        closed_loop=True,
    ),
    "instrumental_variables": Method(
        "instrumental variables for a hysteretic ARMA model; no bias by sensor noise",
        ("hysteretic_arma",),
        _by_regression(instrumental_variables),
    ),
    "least_squares": Method(
        "least squares for a hysteretic ARMA model; sensor noise biases it",
        ("hysteretic_arma",),
        _by_regression(least_squares),
    ),
    "nonnegative_least_squares": Method(
        "weights of Preisach triangles behind the lag that fits best",
        (PLAIN, RATE_DEPENDENT),
        _by_nonnegative_least_squares,
    ),
    "subspace": Method(
        "Hankel-Toeplitz regression with a prior (MAP); one record per input channel",
        ("state_space",),
        by_subspace,
        uses=("order", "window"),
        in_turn=True,
    ),
    "frequency_response": Method(
        "least squares on the transfer matrix of periodic records",
        ("state_space",),
        by_frequency_response,
        uses=("order",),
    ),
    "scheduled_frequency_response": Method(
        "least squares on the transfer matrices of periodic records, by drive level",
        (SCHEDULED,),
        by_amplitude,
        uses=("order", "steps"),
    ),
    "steady_state": Method(
        "Levenberg-Marquardt on the mean of the periods",
        ("bouc_wen", "neural_state_space"),
        _by_steady_state,
        uses=("order", "oversample", "steps"),
    ),
}
"""Methods by name; the first one that can fit a model is its default."""


def method_for(model: str, name: str | None) -> Method:
    """Return the method ``name`` for ``model``, or the default for that model.

    Raises ValueError, listing the valid names, for a method that does not exist or
    cannot fit the model.
    """
    able = [key for key, method in METHODS.items() if model in method.models]
    able = able or [key for key, method in METHODS.items() if not method.models]
    if name is None:
        return METHODS[able[0]]
    if name not in METHODS:
        raise ValueError(f"method {name!r} is unknown; there are {', '.join(METHODS)}")
    if name not in able:
        raise ValueError(f"method {name!r} cannot fit {model!r}; {', '.join(able)} can")
    return METHODS[name]
