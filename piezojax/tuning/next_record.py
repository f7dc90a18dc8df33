"""Design of the next record: what it should determine, and what it will tell."""

from collections.abc import Mapping, Sequence
from math import ceil
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from pydantic import BaseModel

from ..core.arrays import as_array
from ..core.feedback import Feedback
from ..core.paths import get, parameters
from ..core.progress import Progress, Silent
from ..identification.chain import is_own
from ..identification.information import Unknowns
from ..signals.excitation import Generator, excitation
from ..study import Case
from .promised_figures import PromisedFigure, promised_figures
from .record_search import RecordSearch, best_voltages, report_count

DESCENTS = 4, 1
"""Number of descents for the part to fit and for the part to validate on."""

NOTHING_KNOWN = 1e3
"""Vagueness before the record in the errors to expect. A fit to the record alone uses
no other knowledge; the search does, so that one vague parameter does not rule it."""

LEAST = 0.5
"""Least share of a record in front of its move back to the middle of the range."""

EXPECTED_FILE = "expected.json"


class ExpectedFigure(BaseModel):
    """A promised figure, and its standard errors relative to its value.

    ``usual`` is the error after the first half of the usual record of ``excite``.
    """

    name: str
    value: float
    unit: str
    designed: float
    usual: float


class ExpectedParameter(BaseModel):
    """A parameter of the plant with its standard errors, all in ``unit``.

    ``first`` is that of the fit of the plant, None if it is unknown.
    """

    path: str
    value: float
    unit: str
    first: float | None
    designed: float
    usual: float


class RecordReport(BaseModel):
    """Errors to expect after a designed record, the content of ``expected.json``.

    They are those of a fit to the first half of each record alone, of ``designed_s``
    and ``usual_s`` (s), with white noise of ``noise_rms_um``.
    """

    noise_rms_um: float
    designed_s: float
    usual_s: float
    figures: list[ExpectedFigure]
    parameters: list[ExpectedParameter]


class NextRecord(NamedTuple):
    """Voltages (V) to fit a plant to, those to validate it on, and their report."""

    fit: Float[np.ndarray, " samples"]
    validate: Float[np.ndarray, " samples"]
    report: RecordReport


class RecordTask(NamedTuple):
    """The figures that a record should determine, and the search for it."""

    figures: Sequence[PromisedFigure]
    search: RecordSearch

    def errors(
        self, voltages: Float[np.ndarray, " samples"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the standard errors after a record of ``voltages`` (V).

        Those of the figures are relative, those of the parameters in their units.
        """
        found = np.asarray(_covariance(self.search, as_array(voltages)))
        scales = np.asarray(self.search.unknowns.scales)
        figures = np.array([figure.relative_error(found) for figure in self.figures])
        return figures, scales * np.sqrt(np.diag(found))


@eqx.filter_jit
def _covariance(search: RecordSearch, voltages: Array) -> Array:
    return search.covariance(voltages, NOTHING_KNOWN)


def next_record(
    case: Case,
    loop: Feedback,
    generator: Generator,
    samples: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> NextRecord:
    """Return the record that determines the figures of ``loop`` best.

    Each half has at most ``samples``, the move back to the middle included. The figures
    are its tracking errors for the references of ``case``, and its limited
    margins; the sum of their relative variances is minimised. The plant must have been
    fitted. Voltages begin and end at the middle of the range, and stay within the
    limits of ``generator``. Ctrl-C ends the search: its half keeps the best record so
    far, and a half that was not begun is the best random one. Raises ValueError for a
    study with several axes, an amplifier or a sensor without noise, for a plant that
    was not fitted, for another rate than the study's, and for too few samples.
    """
    progress = progress or Silent()
    progress.stage("differentiating the promised figures")
    left = samples - ceil(0.5 * generator.span * generator.rate / generator.slew)
    if left < LEAST * samples:
        raise ValueError(
            f"{samples} samples are too few: the move back to the middle of the range "
            f"takes {samples - left} at {generator.slew:g} V/s"
        )
    task = make_task(case, loop, generator, left, unknowns_of(case))
    progress.stage("designing the record", sum(map(report_count, DESCENTS)))

    def show(loss: float) -> None:
        rms = 100.0 * np.exp(loss) / np.sqrt(len(task.figures))
        progress.advance(rms, f"standard error {rms:.3g} %")

    interrupted, halves = False, []
    for half, descents in enumerate(DESCENTS):
        random = np.random.default_rng([seed, half])
        found, ended = best_voltages(
            task.search, generator, 0 if interrupted else descents, random, show
        )
        interrupted = interrupted or ended
        halves.append(found)
    fit, validate = halves
    progress.stage("comparing with the usual record")
    usual = np.concatenate([part.voltages for part in excitation(generator, seed)[0]])
    report = _report(case, task, fit, usual)
    return NextRecord(_back(generator, fit), _back(generator, validate), report)


def _back(generator: Generator, voltages: np.ndarray) -> np.ndarray:
    """Return ``voltages`` with a move back to the middle of the range."""
    last, middle = float(voltages[-1]), generator.middle
    count = ceil(abs(middle - last) * generator.rate / generator.slew)
    return np.append(voltages, np.linspace(last, middle, count + 1)[1:])


def unknowns_of(case: Case) -> Unknowns:
    """Return the parameters of the plant of ``case`` that a record should determine.

    They are those with a standard error in the origin of the plant, without those that
    differ from record to record. Raises ValueError for a study with several axes or an
    amplifier, and for a plant that was not fitted.
    """
    if case.study.axes is not None:
        raise ValueError("axes: records are designed for one axis")
    if case.amplifier is not None:
        raise ValueError(
            "actuator: records are designed for a plant without an amplifier; leave "
            "out its bandwidth, current and delay: they are in the record"
        )
    known = parameters(case.loop.plant)
    errors = {
        path: error
        for path, error in case.plant_about.standard_errors.items()
        if path in known and np.isfinite(error) and not is_own(path)
    }
    if not errors:
        raise ValueError(
            "plant: its standard errors are unknown; a record is designed for a plant "
            "from a record, or from a file of piezojax.identify"
        )
    return unknowns_at(case, tuple(errors), errors)


def unknowns_at(
    case: Case, paths: Sequence[str], errors: Mapping[str, float] | None = None
) -> Unknowns:
    """Return the parameters of the plant at ``paths`` as unknowns.

    The scale of a parameter is its absolute value, or its standard error in ``errors``
    by path, if that is larger.
    """
    plant, errors = case.loop.plant, errors or {}
    scales = [max(abs(float(get(plant, p))), errors.get(p, 0.0)) for p in paths]
    return Unknowns(plant, tuple(paths), as_array(scales))


def make_task(
    case: Case, loop: Feedback, generator: Generator, samples: int, unknowns: Unknowns
) -> RecordTask:
    """Return the task of a record of ``samples`` for the figures of ``loop``.

    Raises ValueError without noise of the sensor, and for a rate that differs from the
    study's.
    """
    study, noise = case.study, case.study.sensor.noise_rms
    if not (isinstance(noise, float) and noise > 0.0):
        raise ValueError(
            "sensor.noise_rms is 0; the errors to expect depend on it: measure it with "
            "the stage at rest"
        )
    if not np.isclose(generator.rate, study.rate, rtol=1e-6):
        raise ValueError(
            f"the rate of the generator is {generator.rate:g} Hz and that of the study "
            f"{study.rate:g} Hz; they must be equal"
        )
    figures = promised_figures(case, loop, unknowns)
    every = max(1, round(0.5 * generator.rate / generator.top))
    most = min(generator.slew * every / generator.rate, generator.span)
    search = RecordSearch(
        unknowns,
        as_array(sum(figure.sensitivity for figure in figures)),
        as_array(noise),
        as_array(generator.lower),
        as_array(generator.upper),
        as_array(most),
        samples,
        every,
    )
    return RecordTask(figures, search)


def _report(
    case: Case, task: RecordTask, fit: np.ndarray, usual: np.ndarray
) -> RecordReport:
    figures, parameters = (
        np.transpose(both)
        for both in zip(task.errors(fit), task.errors(usual), strict=True)
    )
    plant, about, dt = case.loop.plant, case.plant_about, case.study.dt
    return RecordReport(
        noise_rms_um=float(task.search.noise),
        designed_s=fit.size * dt,
        usual_s=usual.size * dt,
        figures=[
            ExpectedFigure(
                name=figure.name,
                value=figure.value,
                unit=figure.unit,
                designed=designed,
                usual=other,
            )
            for figure, (designed, other) in zip(task.figures, figures, strict=True)
        ],
        parameters=[
            ExpectedParameter(
                path=path,
                value=float(get(plant, path)),
                unit=about.parameter_units.get(path, ""),
                first=about.standard_errors.get(path),
                designed=designed,
                usual=other,
            )
            for path, (designed, other) in zip(
                task.search.unknowns.paths, parameters, strict=True
            )
        ],
    )
