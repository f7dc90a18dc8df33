"""Identification of a plant from records: ``identify``, its report and warnings."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

from ..core.about import About
from ..core.conversion import replaced
from ..core.paths import declared, parameters
from ..core.progress import Progress, Silent
from ..core.system import System
from ..hysteresis.model import hystereses
from .automatic import automatic
from .chain import DEFAULT, by_evidence, shown_dynamics
from .closed_loop import check_approach, feedback_warnings, is_closed
from .estimators.estimate import FittedParameter, LinearDetail, Options
from .estimators.resonances import LinearDynamics
from .held_dynamics import HeldDynamics, combined_bound
from .known_plant import KnownPlant
from .methods import INPUT_BEFORE, ZERO, method_for
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
from .residuals.report import ResidualReport, residual_report
from .residuals.share import unexplained_outputs

MISSED = 0.1
"""Least relative distance of the nearest pole from a resonance that a model lacks."""


class FitError(BaseModel):
    """RMS of the free-run simulation error over a part of the records.

    ``rmse`` is the error over all outputs, ``each`` the error of each output.
    """

    rmse: float
    rmse_percent_of_span: float
    unit: str
    each: list[float] = []


class FitReport(BaseModel):
    """Report of a fit, the content of ``fit.json``.

    ``residuals`` is the analysis of the free-run error; None in files of old versions.
    ``alarms`` are those of ``warnings`` that speak against any use of the model:
    columns or units that are probably wrong, and a model that explains little, lacks a
    large resonance or holds dynamics of another gain.
    ``closed_loop`` says how a record of a closed loop was fitted, and with which bias.
    """

    model: str
    found: str = ""
    closed_loop: str = ""
    parameters: dict[str, FittedParameter]
    train: FitError
    validation: FitError
    residuals: ResidualReport | None = None
    warnings: list[str]
    alarms: list[str] = []
    wall_s: float


class Spectra(NamedTuple):
    """Amplitudes [lines] of an output's sinusoids, without the mean.

    ``frequency`` is in Hz, ``measured`` and ``residual`` (free run minus record) in the
    unit of the output.
    """

    frequency: np.ndarray
    measured: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True)
class Fit:
    """A fitted plant, its report, the records and the simulated outputs.

    The outputs are in the units of the records. ``count`` is the number of fitted
    parameters. ``held`` are the dynamics that were not fitted, ``known`` is the plant
    that was fitted again, if any. ``driven`` are the numbers of the inputs that the
    records drive, one each; it is empty if every record drives all inputs.
    """

    system: System
    report: FitReport
    records: tuple[Record, ...]
    simulations: tuple[np.ndarray, ...]
    train: slice
    validate: slice
    linear: LinearDetail | None = None
    count: int = 0
    held: HeldDynamics | None = None
    known: KnownPlant | None = None
    driven: tuple[int, ...] = ()

    @property
    def plant(self) -> System:
        """The fitted System to save, at the rate of the held dynamics, if any."""
        return self.system if self.held is None else self.held.plant(self.system)

    def errors(self, part: slice) -> list[np.ndarray]:
        """Return the errors over ``part``, [samples, p] for each record."""
        return [
            (run - record.outputs)[part]
            for record, run in zip(self.records, self.simulations, strict=True)
        ]

    def spectra(self, part: slice, output: int) -> Spectra:
        """Return the spectra of an output of the first record over ``part``."""
        measured = self.record.outputs[part, output]

        def amplitude(signal: np.ndarray) -> np.ndarray:
            return np.abs(np.fft.rfft(signal))[1:] * 2.0 / signal.size

        return Spectra(
            np.fft.rfftfreq(measured.size, self.record.dt)[1:],
            amplitude(measured - measured.mean()),
            amplitude(self.errors(part)[0][:, output]),
        )

    def error_over(self, part: slice) -> FitError:
        """Return the RMS of the errors over ``part``."""
        return _fit_error(self.records, self.simulations, part)

    @property
    def about(self) -> About:
        """Origin of the fitted plant, for its file."""
        record = self.record
        driving = self._by_input
        inputs = [unit for one, *_ in driving for unit in one.input_units]
        channels = {"input": inputs, "output": record.output_units}
        units = {
            side if len(each) == 1 else f"{side} {i}": unit
            for side, each in channels.items()
            for i, unit in enumerate(each)
        }
        residuals = self.report.residuals
        about = About(
            record=record.source or None,
            rate_Hz=1.0 / record.dt,
            units=units,
            parameter_units=self._parameter_units(),
            input_ranges=[
                (float(column.min()), float(column.max()))
                for records in driving
                for column in np.concatenate([one.inputs for one in records]).T
            ],
            input_slews=[
                float(slew)
                for records in driving
                for slew in np.max([one.slews for one in records], axis=0)
            ],
            error_bound=None if residuals is None else residuals.error_bound,
            residual_rms=self.report.validation.each,
            standard_errors={
                path: found.standard_error
                for path, found in self.report.parameters.items()
                if found.standard_error is not None
            },
            unsafe=self.report.alarms,
        )
        if self.known is not None:
            return self.known.widened(about)
        if self.held is None:
            return about
        held, bound = self.held, about.error_bound
        changed = {
            "record": f"{about.record}, dynamics of {held.source}",
            "rate_Hz": 1.0 / held.dt,
            "error_bound": combined_bound(bound, held.about.error_bound, held.dt),
            "standard_errors": about.standard_errors | held.standard_errors(),
        }
        return about.model_copy(update=changed)

    @property
    def _by_input(self) -> list[list[Record]]:
        """The records that drive the same inputs, in the order of the inputs."""
        if not self.driven:
            return [list(self.records)]
        return [[self.records[i]] for i in np.argsort(self.driven)]

    def _parameter_units(self) -> dict[str, str]:
        """Return the units of the parameters of the System, by path.

        Parts declare V and um, which stand for the units of the inputs and outputs of
        the record. If its channels differ in unit, that of a parameter is "" (unknown).
        """
        record = self.record
        sides = {"V": set(record.input_units), "um": set(record.output_units)}
        known = {name: "".join(each) for name, each in sides.items() if len(each) == 1}
        found = {}
        for path in parameters(self.plant):
            declaration = declared(self.plant, path)
            unit = declaration.unit if declaration else ""
            unclear = any(name in unit and name not in known for name in sides)
            found[path] = "" if unclear else replaced(unit, known)
        return found

    @property
    def units(self) -> dict[str, str]:
        """Units of the fitted parameters, and of the state before each record."""
        zeros = [name for name in self.report.parameters if name.startswith(ZERO)]
        return {
            **self._parameter_units(),
            INPUT_BEFORE: self.record.input_unit,
            **dict.fromkeys(zeros, self.record.output_unit),
        }

    @property
    def record(self) -> Record:
        """The first record."""
        return self.records[0]

    @property
    def simulated(self) -> np.ndarray:
        """The only simulated output of the first record; ValueError if several."""
        if self.simulations[0].shape[1] != 1:
            raise ValueError(
                f"the model has {self.simulations[0].shape[1]} outputs; it needs one"
            )
        return self.simulations[0][:, 0]


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
        train=_fit_error(records, runs, train),
        validation=_fit_error(records, runs, validate),
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


def _errors(
    records: Sequence[Record], runs: Sequence[np.ndarray], part: slice
) -> np.ndarray:
    """Return the errors over ``part`` of all records, [samples, p]."""
    return np.concatenate(
        [(run - r.outputs)[part] for r, run in zip(records, runs, strict=True)]
    )


def _fit_error(
    records: Sequence[Record], runs: Sequence[np.ndarray], part: slice
) -> FitError:
    each = np.sqrt(np.mean(_errors(records, runs, part) ** 2, axis=0))
    rmse = float(np.sqrt(np.mean(each**2)))
    span = max(float(r.spans.max()) for r in records)
    return FitError(
        rmse=rmse,
        rmse_percent_of_span=100.0 * rmse / span,
        unit=records[0].output_unit,
        each=[float(e) for e in each],
    )
