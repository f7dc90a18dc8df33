"""Result of tuning: the content of ``result.json``, and its reader."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from ..analysis.constraints import CONSTRAINTS, worst_by_plant
from ..analysis.loop_figures import LoopFigures
from ..analysis.stability.measured_margins import MeasuredMargins
from ..core.about import About
from ..core.feedback import Feedback
from ..core.files import read_model
from ..core.metrics import TrackingFigures
from ..core.serial import load, read_about
from ..solve.problem import TOLERANCE
from ..solve.search_state import Status
from ..study import Case, read
from .drive import Drive
from .objective import RAILED
from .sliding import SlidingShare
from .step_tests import StepResult
from .structure_choice import StructureSearch

RESULT_FILE = "result.json"
GAINS_FILE = "gains.toml"
STUDY_FILE = "study.toml"


class Scores(BaseModel):
    """Tracking errors (um) of one set of gains by reference, each of its worst draw.

    The error of a reference is None if a run diverges.
    """

    per_reference_rms_um: dict[str, float | None]
    geomean_rms_um: float | None
    worst_rms_um: float | None
    peak_error_um: dict[str, float | None]
    saturated_percent: dict[str, float]
    peak_voltage_V: float | None  # noqa: N815

    @property
    def stable(self) -> bool:
        """Whether all runs are finite and none stays at a limit (see ``RAILED``)."""
        railed = max(self.saturated_percent.values()) > 100.0 * RAILED
        return self.geomean_rms_um is not None and not railed


class ConstraintOutcome(BaseModel):
    """Outcome of a constraint: its limit, and the worst ``value`` over all plants.

    ``kept`` allows for ``solve.problem.TOLERANCE``. An ``active`` constraint is kept
    with less than 2 % to spare. The constraint is kept on ``on`` of ``of`` plants.
    """

    limit: float
    value: float | None
    unit: str
    sense: Literal["at most", "at least"]
    kept: bool
    active: bool
    on: int
    of: int

    @classmethod
    def of_values(
        cls, name: str, limit: float, values: np.ndarray
    ) -> "ConstraintOutcome":
        """Return the outcome of constraint ``name`` from its values [plants]."""
        kind = CONSTRAINTS[name]
        at_most = kind.sense == "at most"
        values = np.where(np.isfinite(values), values, np.inf if at_most else -np.inf)
        worst = float(values.max() if at_most else values.min())
        sign = 1.0 if at_most else -1.0
        inside = sign * values <= sign * limit * (1.0 + sign * TOLERANCE)
        kept = bool(inside.all())
        near = sign * worst >= sign * limit * (1.0 - sign * 0.02)
        return cls(
            limit=limit,
            value=number(worst),
            unit=kind.unit,
            sense=kind.sense,
            kept=kept,
            active=kept and bool(near),
            on=int(inside.sum()),
            of=values.size,
        )


class FrontPoint(BaseModel):
    """Point of a Pareto front: a limit and the best gains found for it.

    ``kept`` tells whether the gains keep the limit. ``value`` is the worst value of the
    constrained figure on the plants for which it is constrained, ``loss`` the
    objective, and ``geomean_rms_um`` the geometric mean of the errors on the nominal
    plant, None if a run diverges.
    """

    limit: float
    value: float | None
    loss: float
    kept: bool
    geomean_rms_um: float | None
    gains: dict[str, float]


class Perturbed(BaseModel):
    """Figures of the tuned gains on perturbed plants, drawn for the hold-out.

    ``unstable_before`` and ``unstable`` count the plants on which small motions grow,
    or a run diverges or stays at a voltage limit. ``geomeans_before_um`` and
    ``geomeans_um`` hold, by plant, the geometric mean of the errors of the driven axes,
    None where a loop is unstable.
    ``geomean_rms_um`` and ``worst_rms_um`` are the median and the largest of
    ``geomeans_um``. ``median_better`` and ``worst_better`` are the median and the
    smallest ratio of the geometric means before and after, over the plants on which
    both loops are stable; ``coupling_better`` is the median ratio of the axes at rest.
    ``constraints`` holds the outcomes of the limits on these plants, ``values`` the
    constrained figures by plant.
    """

    plants: int
    unstable_before: int
    unstable: int
    geomean_rms_um: float | None
    worst_rms_um: float | None
    median_better: float | None
    worst_better: float | None
    coupling_better: float | None
    geomeans_before_um: list[float | None] = []
    geomeans_um: list[float | None] = []
    constraints: dict[str, ConstraintOutcome] = {}
    values: dict[str, list[float | None]] = {}

    @property
    def geomean_before_rms_um(self) -> float | None:
        """Median of ``geomeans_before_um``; None if a loop is unstable."""
        known = [mean for mean in self.geomeans_before_um if mean is not None]
        usable = known and not self.unstable_before
        return float(np.median(known)) if usable else None

    @classmethod
    def of(
        cls,
        before: LoopFigures,
        after: LoopFigures,
        driven: np.ndarray,
        limits: Mapping[str, float],
    ) -> "Perturbed":
        """Return the summary of figures [plants, traces, draws] before and after.

        The error of a trace is that of its worst draw.
        """
        means, lost = [], []
        for figures in (before, after):
            logarithms, unstable = log_errors(figures)
            means.append(logarithms)
            lost.append(unstable)
        usable = ~lost[0] & ~lost[1]
        better = np.exp(np.mean((means[0] - means[1])[usable][:, driven], axis=1))
        rest = (means[0] - means[1])[usable][:, ~driven]
        every = [np.exp(np.mean(mean[:, driven], axis=1)) for mean in means]
        errors = every[1][~lost[1]]
        values = worst_by_plant(limits, after)
        return cls(
            plants=len(usable),
            unstable_before=int(lost[0].sum()),
            unstable=int(lost[1].sum()),
            geomean_rms_um=number(np.median(errors)) if errors.size else None,
            worst_rms_um=number(errors.max()) if errors.size else None,
            median_better=number(np.median(better)) if better.size else None,
            worst_better=number(better.min()) if better.size else None,
            coupling_better=(
                number(np.median(np.exp(np.mean(rest, axis=1)))) if rest.size else None
            ),
            geomeans_before_um=_numbers(np.where(lost[0], np.nan, every[0])),
            geomeans_um=_numbers(np.where(lost[1], np.nan, every[1])),
            constraints={
                name: ConstraintOutcome.of_values(name, limits[name], np.asarray(found))
                for name, found in values.items()
            },
            values={name: _numbers(found) for name, found in values.items()},
        )


class Beside(BaseModel):
    """Figures of a controller on the hold-out, for a comparison of controllers.

    ``nominal_rms_um`` is the geometric mean of the errors of the driven axes over all
    references of the hold-out, on the nominal plant; ``geomean_rms_um`` and
    ``worst_rms_um`` are its median and its largest value over ``plants`` held-out
    plants. On a plant on which a run diverges or stays at a voltage limit the error is
    infinite; ``unstable`` counts these plants. An infinite figure is None.
    ``sensitivity_peak`` is the largest on these plants, or that of the nominal plant if
    there are none; None if it is not limited.
    """

    nominal_rms_um: float | None
    geomean_rms_um: float | None = None
    worst_rms_um: float | None = None
    plants: int = 0
    unstable: int = 0
    sensitivity_peak: float | None = None


class Result(BaseModel):
    """Result of a tuning run: the content of ``result.json``.

    ``before`` and ``after`` are the scores of the study's own gains and of the tuned
    gains on the tuning references and draws. ``holdout_before`` and ``holdout`` are
    those on held-out noise, and ``unseen_before`` and ``unseen`` those on held-out
    references with held-out noise. On a stage with several axes all of these concern
    the driven axes, each error in its own unit of ``units``. ``coupling_before`` and
    ``coupling`` concern the axes that should rest, under all references of the
    hold-out. ``constraints`` holds the outcomes of the study's limits, and
    ``holdout_constraints`` those of the limits on runs under all references of the
    hold-out; ``front`` is the Pareto front, and ``perturbed`` the figures of the gains
    on the held-out plants of its ensemble. ``beside`` holds the figures of the
    controllers that the study names, then those "before" and "tuned".
    ``sliding_before`` and ``sliding`` hold the share of the tracking error in the
    sliding variable, None for other controllers. ``history`` holds the lowest loss of
    each start after each step, and ``times_s`` the time (s) from the start of the
    search to the end of that step.
    """

    model_config = ConfigDict(extra="ignore")

    study: str
    title: str
    status: Status
    method: str
    gains: dict[str, float]
    start: dict[str, float]
    at_bound: list[str]
    before: Scores
    after: Scores
    holdout_before: Scores
    holdout: Scores
    unseen_before: Scores | None
    unseen: Scores | None
    coupling_before: Scores | None = None
    coupling: Scores | None = None
    constraints: dict[str, ConstraintOutcome] = {}
    holdout_constraints: dict[str, ConstraintOutcome] = {}
    front: list[FrontPoint] | None = None
    perturbed: Perturbed | None = None
    beside: dict[str, Beside] = {}
    drive_before: dict[str, Drive] = {}
    """Figures of the voltage at the piezo before tuning, by axis ("piezo" on one)."""
    drive: dict[str, Drive] = {}
    """The same figures of the tuned gains."""
    steps_before: dict[str, StepResult] = {}
    """Step tests before tuning, by step; none on several axes or at rest."""
    steps: dict[str, StepResult] = {}
    """The same steps with the tuned gains."""
    on_response: dict[str, MeasuredMargins] = {}
    """Margins "before" and "after" on the measured frequency response of the plant."""
    sliding_before: SlidingShare | None = None
    sliding: SlidingShare | None = None
    structures: StructureSearch | None = None
    """Structures of the controller that were tuned; ``gains`` are of the chosen one."""
    units: dict[str, str] = {}
    gain_units: dict[str, str] = {}
    """Declared units of ``gains``; "" without a declaration."""
    gain_steps: dict[str, float] = {}
    """Steps of the gains that are typed into a device."""
    warnings: list[str]
    alarms: list[str] = []
    """Reasons not to use the gains; if there are any, ``load`` refuses their file."""
    history: list[list[float | None]]
    times_s: list[float] = []
    evaluations: int
    compile_s: float
    wall_s: float
    versions: dict[str, str]
    seed: int

    @property
    def heading(self) -> str:
        """Title of tables and figures; it gives the number of alarms, if any."""
        if not self.alarms:
            return self.title
        count = "an alarm" if len(self.alarms) == 1 else f"{len(self.alarms)} alarms"
        return f"UNSAFE, {count}: {self.title}"


def scores(figures: TrackingFigures, names: tuple[str, ...]) -> Scores:
    """Return the Scores of figures [references, draws], each of its worst draw."""
    rms = np.max(np.asarray(figures.rms_error), axis=1)
    peak = np.max(np.asarray(figures.peak_error), axis=1)
    saturated = 100.0 * np.max(np.asarray(figures.saturated), axis=1)
    finite = bool(np.all(np.isfinite(rms)))
    voltage = float(np.max(np.asarray(figures.peak_voltage)))
    return Scores(
        per_reference_rms_um=dict(zip(names, map(number, rms), strict=True)),
        geomean_rms_um=number(np.exp(np.mean(np.log(rms)))) if finite else None,
        worst_rms_um=number(np.max(rms)) if finite else None,
        peak_error_um=dict(zip(names, map(number, peak), strict=True)),
        saturated_percent={
            name: float(share) for name, share in zip(names, saturated, strict=True)
        },
        peak_voltage_V=number(voltage),
    )


def log_errors(figures: LoopFigures) -> tuple[np.ndarray, np.ndarray]:
    """Return ln of the RMS errors (um) [plants, traces], and the lost plants.

    The error of a trace is that of its worst draw. A plant is lost if small motions on
    it grow, or a run diverges or stays at a voltage limit.
    """
    rms = np.max(np.asarray(figures.tracking.rms_error), axis=2)
    lost = np.max(np.asarray(figures.tracking.saturated), axis=(1, 2)) > RAILED
    lost |= ~np.all(np.isfinite(rms), axis=1)
    if figures.stable is not None:
        lost |= ~np.asarray(figures.stable)
    with np.errstate(divide="ignore"):
        return np.log(rms), lost


def number(value: float) -> float | None:
    """Return ``value``, None if it is not finite: JSON has no infinity."""
    return float(value) if np.isfinite(value) else None


def _numbers(values: Any) -> list[float | None]:
    return [number(value) for value in np.asarray(values)]


def load_result(path: str | Path) -> Result:
    """Return the Result in a ``result.json``, or in the folder that holds one.

    Raises ValueError if the file is missing or damaged.
    """
    path = Path(path)
    path = path / RESULT_FILE if path.is_dir() else path
    return read_model(Result, path, "is not a result of tuning")


def load_loop(
    folder: Path, study: Path | None = None, *, accept_unsafe: bool = False
) -> tuple[Case, Feedback]:
    """Return the Case and the tuned loop of a ``folder`` of ``tune``.

    ``study`` is the file of the study, by default the one in the folder. Raises
    ValueError as ``study.read``, ``load`` and ``require_own`` do.
    """
    case, file = read(study or folder / STUDY_FILE), folder / GAINS_FILE
    controller = load(file, accept_unsafe=accept_unsafe)
    if study is None:
        require_own(case, read_about(file), file)
    return case, replace(case.loop, controller=controller)


def require_own(case: Case, about: About, file: Path) -> None:
    """Raise ValueError if ``case`` is not that of the gains in ``file``.

    ``case`` was built from the study beside them, and ``about`` is their origin.
    """
    if about.study_sha256 not in (None, case.sha256):
        raise ValueError(
            f"{file.with_name(STUDY_FILE)} is not the study of {file}, or a file that "
            "it names has changed since: the SHA-256 differs"
        )
