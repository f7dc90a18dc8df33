"""Fit of a plant to records, with its report."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

from ..core.about import About
from ..core.conversion import replaced
from ..core.paths import declared, parameters
from ..core.system import System
from .estimators.estimate import FittedParameter, LinearDetail
from .held_dynamics import HeldDynamics, combined_bound
from .known_plant import KnownPlant
from .methods import INPUT_BEFORE, ZERO
from .records.record import Record
from .residuals.report import ResidualReport


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
        return fit_error(self.records, self.simulations, part)

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


def _errors(
    records: Sequence[Record], runs: Sequence[np.ndarray], part: slice
) -> np.ndarray:
    """Return the errors over ``part`` of all records, [samples, p]."""
    return np.concatenate(
        [(run - r.outputs)[part] for r, run in zip(records, runs, strict=True)]
    )


def fit_error(
    records: Sequence[Record], runs: Sequence[np.ndarray], part: slice
) -> FitError:
    """Return the RMS of the errors of ``runs`` over ``part`` of the records."""
    each = np.sqrt(np.mean(_errors(records, runs, part) ** 2, axis=0))
    rmse = float(np.sqrt(np.mean(each**2)))
    span = max(float(r.spans.max()) for r in records)
    return FitError(
        rmse=rmse,
        rmse_percent_of_span=100.0 * rmse / span,
        unit=records[0].output_unit,
        each=[float(e) for e in each],
    )
