"""Fits to records of a closed loop: direct, indirect and joint.

In a closed loop with ``u = K_r r + d - K_y y``, noise reaches the input. An estimator
made for open loops, which takes the input as independent of the noise, is then biased
towards ``-1 / K_y``. Sources: Ljung, System Identification, 2nd ed., 13.4 and 13.5;
Forssell and Ljung, Automatica 35, 1999; Van den Hof and Schrama, Automatica 29, 1993.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..core.arrays import as_array
from ..core.paths import static_fields
from ..core.progress import Progress
from ..core.space import space_of
from ..core.system import System
from ..hysteresis.model import hystereses
from .chain import structure, training_record
from .estimators.controlled_stage import ControlledStage, loop_drive, replayed
from .estimators.error_problem import Problem
from .estimators.estimate import Options
from .estimators.output_error import Optimum, output_error
from .estimators.projection import projected
from .estimators.structure import Structure
from .records.record import Record
from .residuals.correlation import Correlation, autocorrelation
from .residuals.input_feedback import SHARE, feedback_share

APPROACHES = {
    "direct": "prediction error from the input, with a noise model; unbiased if that "
    "model whitens the errors, biased towards -1 / controller if not; needs neither "
    "reference nor controller",
    "indirect": "free run of the whole loop from its excitation, with a known "
    "controller; unbiased whatever the noise, as inaccurate as the controller; "
    "ignores voltage limits",
    "joint": "prediction error from the part of the input that responds to the "
    "excitation; unbiased for long records whatever the noise; linear chains only",
}
"""Approaches to records of a closed loop by name, with the bias of each."""

REPLAYED = 0.05
"""Error of the controller's voltage, as a share of the deviation of the recorded one,
above which the controller does not match that of the loop."""

NOISY = 0.5
"""Share of noise in the input from which joint is noticeably biased."""

WIDER = 4.0
"""Factor on the bounds of the modes that a record shows. In an open loop narrow bounds
protect the modes from the errors of a hysteresis. Here the noise model protects them,
and the modes that a record shows are less certain."""


class LoopFit(NamedTuple):
    """An optimum, the stage in its best System, and a ``text`` on the bias.

    ``inside`` is the path of the stage in the fitted System, with a dot at its end.
    ``scatter_known`` tells whether the standard errors of the optimum hold.
    """

    optimum: Optimum
    system: System
    shape: Structure
    text: str
    warnings: list[str]
    inside: str = ""
    scatter_known: bool = True


def check_approach(records: Sequence[Record], options: Options) -> None:
    """Raise ValueError unless approach and controller in ``options`` suit ``records``.

    Indirect and joint need a reference or a dither that changes. Indirect also needs
    the controller, at the sampling rate of the record, and a single record; no other
    approach takes a controller.
    """
    name, controller = options.closed_loop, options.controller
    if name is None and controller is None:
        return
    if name is not None and name not in APPROACHES:
        raise ValueError(
            f"closed_loop {name!r} is unknown; there are {', '.join(APPROACHES)}"
        )
    if name in ("indirect", "joint"):
        for record in records:
            if not record.excitation.size:
                raise ValueError(
                    f"{record.source}: {name} needs the reference or the dither of the "
                    "loop, and neither changes in this record; direct needs none"
                )
    if (controller is None) == (name == "indirect"):
        raise ValueError(
            "indirect needs the controller of the loop, and no other approach takes one"
        )
    if controller is None:
        return
    if len(records) > 1:
        raise ValueError(f"{len(records)} records; indirect takes one")
    for dt in {float(dt) for dt in static_fields(controller, "dt")}:
        if not np.isclose(dt, records[0].dt, rtol=1e-6, atol=0.0):
            raise ValueError(
                f"the controller runs at {1.0 / dt:g} Hz and {records[0].source} at "
                f"{1.0 / records[0].dt:g} Hz; they must be the same"
            )


def is_closed(records: Sequence[Record], options: Options) -> bool:
    """Return whether the ``records`` are to be fitted as those of a closed loop."""
    return options.closed_loop is not None or any(r.closed_loop for r in records)


def loop_fit(
    model: str,
    records: Sequence[Record],
    train: slice,
    options: Options,
    progress: Progress,
) -> LoopFit:
    """Fit the chain ``model`` to ``records`` of a closed loop.

    Without a name in ``options`` the approach is direct; a linear chain whose
    prediction errors are not white is fitted again by joint if there is an excitation.
    Raises ValueError as ``structure``, ``without_noise`` and ``output_error`` do, for
    joint with a hysteresis, and for indirect without a controller.
    """
    if options.closed_loop is not None:
        return _FITS[options.closed_loop](model, records, train, options, progress)
    found = _direct(model, records, train, options, progress)
    excited = all(record.excitation.size for record in records)
    if not found.warnings or not excited or hystereses(found.system):
        return found
    again = _joint(model, records, train, options, progress)
    return again._replace(text=f"{again.text}; direct rejected: {found.warnings[0]}")


def _direct(
    model: str,
    records: Sequence[Record],
    train: slice,
    options: Options,
    progress: Progress,
) -> LoopFit:
    shape = _structure(model, training_record(records, train))
    optimum = output_error(
        shape, records, train, steps=options.steps, progress=progress, noise_model=True
    )
    white = whiteness(optimum.problem, optimum.units[0])
    warnings = []
    if white.significant:
        warnings.append(
            "the noise model does not whiten the prediction errors (correlation "
            f"{white.value:.2g} at {white.lag} samples, {white.bound:.2g} is chance): "
            "the direct estimate may be biased towards -1 / controller; a reference "
            "and --closed-loop joint or indirect would avoid this"
        )
    text = "direct, prediction error with a noise model; unbiased if its errors are"
    text += f" white (correlation {abs(white.value):.2g}, {white.bound:.2g} is chance)"
    return LoopFit(optimum, optimum.system, shape, text, warnings)


def _joint(
    model: str,
    records: Sequence[Record],
    train: slice,
    options: Options,
    progress: Progress,
) -> LoopFit:
    parts = [record.until(train.stop) for record in records]
    clean = [without_noise(part) for part in parts]
    shape = _structure(model, training_record(clean, train))
    if hystereses(shape.system):
        raise ValueError(
            f"{model}: joint takes the input as a linear response to the reference, "
            "and behind a hysteresis it is not: use direct or indirect"
        )
    optimum = output_error(
        shape, clean, train, steps=options.steps, progress=progress, noise_model=True
    )
    share = [
        float(np.var(own.input - whole.input) / np.var(whole.input))
        for own, whole in zip(clean, parts, strict=True)
    ]
    excited = 100.0 * (1.0 - max(share))
    warnings = []
    if max(share) > NOISY:
        warnings.append(
            f"only {excited:.2g} % of the input's power responds to the excitation: "
            "joint keeps a share of the noise, and was biased by several percent on "
            "such records; use a stronger excitation, direct or indirect"
        )
    text = (
        "joint, from the part of the input that responds to the excitation "
        f"({excited:.3g} % of its power); unbiased for a long record"
    )
    # The standard errors of the fit do not include the scatter of the projection.
    return LoopFit(optimum, optimum.system, shape, text, warnings, scatter_known=False)


def _indirect(
    model: str,
    records: Sequence[Record],
    train: slice,
    options: Options,
    progress: Progress,
) -> LoopFit:
    (record,), controller = records, options.controller
    if controller is None:
        raise ValueError("indirect needs the controller of the loop")
    shape = _structure(model, without_noise(record.until(train.stop)))
    loop = ControlledStage(shape.system, controller, record.input[0])

    def inside(path: str) -> str:
        return f"plant.{path}"

    ranges = {inside(path): each for path, each in shape.space.ranges().items()}
    whole = shape._replace(
        system=loop,
        space=space_of(ranges),
        own=tuple(map(inside, shape.own)),
        dynamics=tuple(map(inside, shape.dynamics)),
    )
    optimum = output_error(
        whole,
        records,
        train,
        steps=options.steps,
        progress=progress,
        noise_model=True,
        drives=[loop_drive(record)],
    )
    off = _replay_error(controller, record, train)
    warnings = []
    if off > REPLAYED:
        warnings.append(
            "the controller does not explain the recorded voltage: it is "
            f"{100.0 * off:.2g} % of its deviation away; gains, limits or timing "
            "differ, and the indirect estimate is as inaccurate"
        )
    text = (
        "indirect, free run of the whole loop; unbiased whatever the noise if the "
        f"controller is right (its voltage is within {100.0 * off:.2g} % of the record)"
    )
    system = optimum.system
    if not isinstance(system, ControlledStage):
        raise TypeError(f"a {type(system).__name__} is no ControlledStage")
    return LoopFit(optimum, system.plant, shape, text, warnings, "plant.")


_FITS = {"direct": _direct, "indirect": _indirect, "joint": _joint}


def _structure(model: str, record: Record) -> Structure:
    """Return the chain with wide bounds; a parameter at a bound raises a warning."""
    return structure(model, record, reach=WIDER)._replace(whitening=())


ALARMING = 0.2
"""Share explained by past outputs above which a record raises an alarm. Smooth voltages
of open loops reach 0.1, because the outputs contain information on older voltages."""

_OPEN = (
    "this fit is for open loops and biased towards -1 / controller where noise drives "
    "the input: name the --reference of the loop, or fit a chain by --closed-loop "
    "direct"
)


def feedback_warnings(
    records: Sequence[Record], train: slice
) -> tuple[list[str], list[str]]:
    """Return alarms and notes on records of closed loops fitted as open ones.

    Past outputs that explain more than ``ALARMING`` of the unpredictable part of the
    input raise an alarm.
    """
    alarms, notes = [], []
    for record in records:
        if not record.single:
            continue
        if record.closed_loop:
            notes.append(
                f"{record.source}: its reference or dither shows that it was made by "
                f"feedback; {_OPEN}"
            )
            continue
        share = feedback_share(record.input[train], record.output[train])
        if share >= SHARE:
            found = alarms if share > ALARMING else notes
            found.append(
                f"{record.source}: past outputs explain {100.0 * share:.2g} % of the "
                "unpredictable part of its input. If the output was smoothed by a "
                "filter that looks ahead, which hides resonances, use the output as it "
                f"was measured. If the input was made by feedback, {_OPEN}"
            )
    return alarms, notes


def without_noise(record: Record) -> Record:
    """Return ``record`` with its input reduced to the response to the excitation.

    Raises ValueError as ``projected`` does.
    """
    try:
        return replace(record, inputs=projected(record.input, record.excitation))
    except ValueError as error:
        raise ValueError(f"{record.source}: {error}") from None


def whiteness(problem: Problem, unit: np.ndarray) -> Correlation:
    """Return the largest autocorrelation of the prediction errors over all records.

    Correlations are compared relative to their bounds.
    """
    errors = np.asarray(problem.whitened(problem.errors(as_array(unit))))
    tests = [
        autocorrelation(each[used > 0.0])
        for each, used in zip(errors, np.asarray(problem.weights), strict=True)
    ]
    return max(tests, key=lambda test: abs(test.value) / test.bound)


def _replay_error(controller: System, record: Record, train: slice) -> float:
    """Return the error of the controller's voltage relative to the recorded voltage.

    It is a ratio of standard deviations over ``train``. The mean error does not count,
    because it depends on the unknown state of the integrator at the start.
    """
    wanted = record.input[train]
    error = (replayed(controller, record) - record.input)[train]
    return float(np.std(error) / max(np.std(wanted), 1e-300))
