"""Identification of a plant from records: ``identify``, with its warnings."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ..core.progress import Progress, Silent
from ..core.system import System
from ..hysteresis.model import hystereses
from .automatic import automatic
from .chain import DEFAULT, by_evidence, shown_dynamics
from .closed_loop import check_approach, feedback_warnings, is_closed
from .estimators.estimate import LinearDetail, Options
from .estimators.resonances import LinearDynamics
from .fit import Fit, FitReport, fit_error
from .methods import method_for
from .plausibility import assumed_units, early_warnings, plausibility_warnings
from .records.checks import record_warnings
from .records.parts import (
    check_compatible,
    check_train,
    longest_first,
    longest_first_places,
    train_and_validation,
)
from .records.record import Record
from .residuals.report import residual_report
from .residuals.share import unexplained_outputs

MISSED = 0.1
"""Least relative distance of the nearest pole from a resonance that a model lacks."""


def identify(
    records: Record | Sequence[Record],
    model: str = DEFAULT,
    *,
    method: str | None = None,
    train: slice | None = None,
    validate: slice | None = None,
    options: Options | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit ``model`` to one record or to several with the same sample time.

    ``model`` is a chain of parts such as ``"prandtl_ishlinskii+logarithmic_creep+lag"``
    (see ``--model help``) or one of the models of ``identification.METHODS``; the
    default is a chain with the resonances, lag and delay that the record shows, and
    with the hysteresis that describes it best (``automatic``).
    ``method`` is a name in METHODS; left out, it is the first that can fit the model.
    The model is fitted over the samples ``train`` of each record (the first half of the
    longest if left out) and validated by its free run on ``validate`` (the rest if left
    out). A record without samples in ``validate`` is used for the fit only. Each of
    several records has its own zero of the sensor and its own initial state.
    For ``state_space`` from records that are not periodic, each record drives one input
    of the stage alone: the first record input 0, the second input 1, and so on.
    ``Fit.records`` are sorted by length, the longest first.
    Records are fitted as those of a closed loop if one has a reference or dither, or if
    ``options.closed_loop`` names an approach. Only ``output_error`` does so; the other
    methods refuse an approach, and otherwise warn of their bias.
    Raises ValueError for an unknown model or method, an empty part, records of
    different sample time or units, an approach that does not suit records or method, or
    if no start leads to a finite fit.
    """
    began, options = time.perf_counter(), options or Options()
    records = (records,) if isinstance(records, Record) else tuple(records)
    check_compatible(records)
    given, records = records, longest_first(records)
    train, validate = train_and_validation(records[0].samples, train, validate)
    check_train(records, train)
    check_approach(records, options)
    if model == DEFAULT:
        first, *beside = by_evidence(records, train)
        model, found = automatic(first, progress, beside, options.dynamics)
        options = replace(options, begun=found)
    chosen, held = method_for(model, method), options.dynamics
    if held is not None and chosen.models:
        raise ValueError(
            f"the dynamics come from {held.source}: {model} has its own; name a chain "
            "such as coleman_hodgdon+exponential_creep"
        )
    if held is not None and is_closed(records, options):
        raise ValueError(
            f"the dynamics come from {held.source}: they are held in records of an "
            "open loop only; leave out the reference, the dither and the approach"
        )
    if options.closed_loop is not None and not chosen.closed_loop:
        raise ValueError(
            f"the method for {model!r} is for open loops; output_error fits a chain to "
            f"a record of a closed loop by {options.closed_loop}"
        )
    estimate = chosen.estimate(
        model,
        given if chosen.in_turn else records,
        train,
        options,
        progress or Silent(),
    )
    runs, driven = estimate.simulations, ()
    if chosen.in_turn:
        driven = longest_first_places(given)
        runs = tuple(runs[i] for i in driven)
    shown = estimate.shown or shown_dynamics(records, train)
    feedback = ([], []) if estimate.closed_loop else feedback_warnings(records, train)

    def of_each(check: Callable[[Record], Iterable[str]]) -> list[str]:
        return [
            f"{record.source}: {text}" if len(records) > 1 else text
            for record in records
            for text in check(record)
        ]

    alarms = of_each(plausibility_warnings)
    if not estimate.closed_loop:
        alarms += of_each(partial(early_warnings, train=train))
    alarms += feedback[0]
    alarms += unexplained_outputs(records, runs, validate)
    gains = ([], []) if held is None else held.gain_notes(records[0])
    alarms += gains[0]
    residuals, missing, unexplained = residual_report(records, runs, train, validate)
    alarms += missing
    checked = partial(
        record_warnings,
        train=train,
        validate=validate,
        # A resonance that appears in the record was excited.
        order=0 if shown.modes else estimate.order,
        hysteresis=estimate.hysteresis,
    )
    report = FitReport(
        model=model,
        found=str(shown) if held is None else f"dynamics of {held.source}, held",
        closed_loop=estimate.closed_loop,
        parameters=estimate.parameters,
        train=fit_error(records, runs, train),
        validation=fit_error(records, runs, validate),
        residuals=residuals,
        warnings=[
            *alarms,
            *feedback[1],
            *of_each(assumed_units),
            *of_each(checked),
            *estimate.warnings,
            *gains[1],
            *_missed(shown, estimate.linear),
            *_without_inverse(estimate.system, records),
            *unexplained,
        ],
        alarms=alarms,
        wall_s=time.perf_counter() - began,
    )
    return Fit(
        estimate.system,
        report,
        records,
        runs,
        train,
        validate,
        estimate.linear,
        estimate.parameter_count(),
        held,
        options.known,
        driven,
    )


def _missed(shown: LinearDynamics, linear: LinearDetail | None) -> list[str]:
    """Return a warning for each resonance that a linear model lacks."""
    if linear is None:
        return []
    poles = linear.model.poles().astype(complex)
    rates = np.log(poles[np.abs(poles) > 1e-9]) / linear.model.dt
    frequencies = np.abs(rates) / (2.0 * np.pi)
    return [
        f"the record shows a resonance at {mode.frequency:.4g} Hz that the model lacks"
        for mode in shown.modes
        if np.all(np.abs(frequencies / mode.frequency - 1.0) > MISSED)
    ]


def _without_inverse(system: System, records: Sequence[Record]) -> list[str]:
    """Return a warning if a hysteresis of ``system`` has no inverse in the records."""
    static = [each for each in hystereses(system) if not each.dynamic]
    if not static or not all(record.single for record in records):
        return []
    low, high = (f([f(r.input) for r in records]) for f in (np.min, np.max))
    try:
        static[0].inverse(low, high)
    except ValueError as error:
        return [
            f"the hysteresis has no inverse from {low:g} to {high:g} "
            f"{records[0].input_unit}, but inversion feedforward needs one: {error}"
        ]
    return []
