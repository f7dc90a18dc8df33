"""Tables of a study file, and their validation."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ..analysis.constraints import CONSTRAINTS, limits_of
from ..core.plain import shown
from ..signals import motions
from ..signals import waveforms as signals
from ..solve.optimisers import GAUSS_NEWTON, METHODS
from .ensemble_table import EnsembleTable
from .file_tables import NoiseFile, TrajectoryTable, check_trajectory_name
from .stage_tables import Actuator, DisturbanceTable, SensorTable
from .structure_table import StructuresTable
from .sweep_table import SweepTable, require_quoted_paths
from .tables import (
    ByAxis,
    Finite,
    NotNegative,
    Positive,
    RangeTable,
    Table,
    example,
    in_unit,
    one_of,
    unknown_key,
)

_OWN_LISTS = ("tune", "unseen", "files")
"""Keys whose lists are not values by axis."""

MEMORY_GB = 4.0
"""Largest memory of the signals of a study, GB. Tuning takes several times as much."""


class AxesTable(Table):
    """Names and units of the axes of a multi-axis stage."""

    model_config = example({"names": ["x", "y"], "units": ["um", "um"]})

    names: tuple[str, ...] = Field(min_length=2)
    """Names of the axes, of letters, digits and _; they differ in more than upper and
    lower case."""
    units: tuple[str, ...]
    """Unit of each axis, um or urad."""

    @model_validator(mode="after")
    def _consistent(self) -> "AxesTable":
        if len(self.units) != len(self.names) or len(set(self.names)) < len(self.names):
            raise ValueError("names must differ and have one unit each")
        if len({name.casefold() for name in self.names}) < len(self.names):
            raise ValueError(
                f"names are {', '.join(self.names)}; they must differ in more than "
                "upper and lower case, because files are named after them"
            )
        for unit in self.units:
            one_of(unit, ("um", "urad"))
        for name in self.names:
            if not name.isidentifier():
                raise ValueError(
                    f"axis {shown(name)}: a name consists of letters, digits and _"
                )
        return self


class References(Table):
    """References of the runs, by the names of their signals or trajectories."""

    model_config = example(
        {
            "tune": ["SIN10", "SW50"],
            "unseen": ["SIN20"],
            "amplitude": 5.0,
            "duration": 0.5,
            "settle": 0.25,
        }
    )

    tune: tuple[str, ...] = Field(min_length=1)
    """References of the objective: signals such as ``SIN10``, or names of ``files``. On
    several axes the driven axes precede the signal, as in ``x:SIN10``."""
    unseen: tuple[str, ...] = ()
    """Other references, used only to evaluate the tuned gains."""
    amplitude: Annotated[ByAxis[Positive], in_unit("um or urad")] = 5.0
    """Amplitude of the signals."""
    offset: Annotated[ByAxis[Finite], in_unit("um or urad")] = 0.0
    """Offset of the signals."""
    duration: Annotated[Positive, in_unit("s")] = 1.0
    """Duration of each run, at least 2 samples."""
    settle: Annotated[NotNegative, in_unit("s")] = 0.5
    """Time after which errors count, below ``duration``."""
    files: dict[str, TrajectoryTable] = Field(default_factory=dict)
    """Trajectories in files, by name; they have an offset of their own and no
    amplitude."""

    @field_validator("tune", "unseen")
    @classmethod
    def _signals(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{name} is listed twice")
        return names

    @model_validator(mode="after")
    def _consistent(self) -> "References":
        if self.settle >= self.duration:
            raise ValueError(
                f"settle is {self.settle:g} s; it must be below the duration, "
                f"{self.duration:g} s"
            )
        for name in self.unseen:
            if name in self.tune:
                raise ValueError(f"{name} is in both tune and unseen")
        for name in self.files:
            check_trajectory_name(name)
            if name not in (*self.tune, *self.unseen):
                raise ValueError(f"files.{name} is in neither tune nor unseen")
        return self


class TunedTable(RangeTable):
    """Range of a tuned parameter, in the unit of the parameter.

    The declaration of the parameter supplies bounds and a scale that are left out.
    """

    model_config = example({"lower": 1.0, "upper": 1e4, "scale": "log"})

    start: Finite | None = None
    """Start of the search; without this key the value in the controller."""
    within: Annotated[float, Field(gt=1.0, allow_inf_nan=False)] | None = None
    """Factor by which the parameter may differ from its start, instead of ``lower`` and
    ``upper``: for a start that a design computes for the plant."""

    @model_validator(mode="after")
    def _one_pair_of_bounds(self) -> "TunedTable":
        if self.within is not None and (self.lower, self.upper) != (None, None):
            raise ValueError("within stands for lower and upper; leave these out")
        return self

    def bounded(self, value: float, where: str) -> "TunedTable":
        """Return the table with the bounds of ``within`` around ``value``, if given.

        Raises ValueError, beginning with ``where``, for a value that is not positive.
        """
        if self.within is None:
            return self
        if value <= 0.0:
            raise ValueError(
                f"{where}.within needs a start above 0; the start is {value:g}"
            )
        ends = {"lower": value / self.within, "upper": value * self.within}
        return self.model_copy(update=ends)


class BesideTable(Table):
    """Controller that is not tuned, to compare the tuned one with."""

    model_config = example(
        {
            "controller": {"catalog": "p753_disturbance_observer"},
            "gains": {"cutoff": 1066.0},
        }
    )

    controller: dict[str, Any]
    """Controller, as in ``[controller]``."""
    gains: dict[str, Finite] = Field(default_factory=dict)
    """Values of parameters by their path in the controller, in the unit of each."""

    @field_validator("gains", mode="before")
    @classmethod
    def _quoted(cls, values: Any) -> Any:
        return require_quoted_paths(values)


class ParetoTable(Table):
    """Pareto front: the study is solved for each limit of one constraint."""

    model_config = example(
        {"constraint": "sensitivity_peak", "limits": [2.0, 1.8, 1.6, 1.4]}
    )

    constraint: str
    """Name of a constraint with a limit, in ``[constraints]`` or by default."""
    limits: tuple[Positive, ...] = Field(min_length=2)
    """Limits, in the unit of the constraint."""
    steps: Annotated[int, Field(strict=True, ge=1, le=10000)] = 30
    """Largest number of optimiser steps at each limit."""

    @field_validator("constraint")
    @classmethod
    def _known(cls, name: str) -> str:
        return one_of(name, CONSTRAINTS)


class ObjectiveTable(Table):
    """Objective of the tuning: rms tracking errors, relative to those before tuning."""

    model_config = example({"aggregate": "worst", "noise_draws": 4})

    aggregate: Literal["geometric_mean", "mean_square", "worst"] = "geometric_mean"
    """Objective of several references: the geometric mean of their errors, the mean of
    the squares, or a smooth maximum."""
    coupling_weight: NotNegative = 1.0
    """Weight of the errors of axes at rest, on several axes."""
    effort_weight: NotNegative = 0.0
    """Weight of the rms voltage, as a share of the voltage range."""
    slew_weight: NotNegative = 0.0
    """Weight of the rms change of the voltage from sample to sample, as a share of the
    voltage range."""
    noise_draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 1
    """Draws of the noise for each reference."""


class OptimiserTable(Table):
    """Optimiser of the objective."""

    model_config = example({"starts": 4, "candidates": 64, "steps": 40})

    method: str = "gauss_newton"
    """Optimiser; ``levenberg_marquardt`` needs the aggregate ``mean_square``, and
    ``mean`` in an ensemble."""
    starts: Annotated[int, Field(strict=True, ge=1, le=256)] = 8
    """Number of starting points: the start of the study and the best candidates."""
    candidates: Annotated[int, Field(strict=True, ge=0, le=65536)] = 64
    """Number of points of the box that are simulated to choose the starts."""
    steps: Annotated[int, Field(strict=True, ge=1, le=10000)] = 60
    """Largest number of steps from each start."""
    tolerance: Positive = 1e-4
    """Relative change of the point and the objective below which a search ends."""

    @field_validator("method")
    @classmethod
    def _known(cls, name: str) -> str:
        return one_of(name, (*METHODS, GAUSS_NEWTON))


class Study(Table):
    """A study: a stage, its controller, references, and parameters to tune."""

    model_config = example(
        {
            "title": "PID of the P-753 at 20 kHz",
            "rate": 20e3,
            "plant": {"catalog": "p753_stage"},
            "actuator": {"lower": -20.0, "upper": 120.0},
            "sensor": {"noise_rms": 0.002},
            "controller": {"catalog": "p753_pid"},
            "references": {"tune": ["SIN10", "SW10"], "unseen": ["SIN20"]},
            "tune": ["controller.*"],
        }
    )

    title: str
    """Title of the results."""
    rate: Annotated[Positive, in_unit("Hz")]
    """Sampling rate."""
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    """Seed of all random draws."""
    axes: AxesTable | None = None
    """Axes of a stage with several."""
    plant: dict[str, Any]
    """Plant, from voltage (V) to displacement (um, urad)."""
    actuator: Actuator
    """Drive of the stage."""
    sensor: SensorTable = SensorTable()
    """Sensor of the displacement."""
    controller: dict[str, Any]
    """Controller, with the gains before tuning."""
    references: References
    """References of the runs."""
    tune: tuple[str, ...] = ()
    """Parameters to tune within declared bounds: paths in the loop, or patterns such as
    ``controller.feedback.*``."""
    parameters: dict[str, TunedTable] = Field(default_factory=dict)
    """Parameters to tune, by path, and their ranges. At least one parameter must be
    named here or in ``tune``."""
    objective: ObjectiveTable = ObjectiveTable()
    """Objective of the tuning."""
    optimiser: OptimiserTable = OptimiserTable()
    """Optimiser of the objective."""
    disturbance: DisturbanceTable = DisturbanceTable()
    """Disturbances of the stage."""
    ensemble: EnsembleTable | None = None
    """Perturbed stages."""
    constraints: dict[str, Any] = Field(default_factory=dict)
    """Limits on figures of the loop, by name."""
    pareto: ParetoTable | None = None
    """Pareto front."""
    holdout_draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 1
    """Draws of the noise of the hold-out, for each reference."""
    beside: dict[str, BesideTable] = Field(default_factory=dict)
    """Controllers that are not tuned, by name, to compare the tuned one with."""
    sweep: SweepTable | None = None
    """Points and metrics of ``python -m piezojax.sweep``."""
    structures: StructuresTable | None = None
    """Numbers of notches to compare."""

    @field_validator("parameters", mode="before")
    @classmethod
    def _quoted(cls, tables: Any) -> Any:
        return require_quoted_paths(tables)

    @model_validator(mode="after")
    def _tuned(self) -> "Study":
        if not (self.tune or self.parameters):
            raise ValueError(
                "tune and parameters are missing; name at least one parameter to tune"
            )
        return self

    @model_validator(mode="after")
    def _sampled(self) -> "Study":
        table = self.references
        self._check_memory()
        samples = round(table.duration * self.rate)
        if samples < 2:
            raise ValueError(
                f"references.duration is {table.duration:g} s, {samples} samples; "
                "at least 2 are needed"
            )
        for name in (*table.tune, *table.unseen):
            try:
                driven = self.driven(name)
            except ValueError as error:
                part = "tune" if name in table.tune else "unseen"
                raise ValueError(f"references.{part}: {error}") from None
            if name in table.files:
                continue
            for kind in driven.values():
                frequency = signals.parse(kind)[1] or 0.0
                if frequency >= 0.5 * self.rate:
                    raise ValueError(
                        f"references: the frequency of {name} is not below half the "
                        f"rate, {0.5 * self.rate:g} Hz"
                    )
        if self.settled >= samples:
            raise ValueError(
                f"references.settle is {table.settle:g} s; no sample is left after it"
            )
        return self

    def _check_memory(self) -> None:
        """Raise ValueError if the signals of the runs would not fit in the memory."""
        table = self.references
        runs = (len(table.tune) + len(table.unseen)) * self.axis_count
        draws = self.objective.noise_draws + self.holdout_draws
        # A reference, and in each draw its noise and its drift, of 8 bytes per sample.
        samples = table.duration * self.rate
        gigabytes = samples * runs * (1 + 2 * draws) * 8e-9
        if not gigabytes <= MEMORY_GB:
            raise ValueError(
                f"references.duration is {table.duration:g} s: at {self.rate:g} Hz "
                f"the signals of all references have {samples:.3g} samples each and "
                f"take {gigabytes:.3g} GB; the limit is {MEMORY_GB:g} GB"
            )

    @model_validator(mode="after")
    def _least_squares(self) -> "Study":
        least_squares = self.optimiser.method == "levenberg_marquardt"
        if least_squares and self.objective.aggregate != "mean_square":
            raise ValueError(
                "optimiser.method levenberg_marquardt minimises squares; "
                f"objective.aggregate is {self.objective.aggregate!r}, "
                "it must be 'mean_square'"
            )
        if least_squares and self.ensemble and self.ensemble.aggregate != "mean":
            raise ValueError(
                "optimiser.method levenberg_marquardt minimises squares; "
                f"ensemble.aggregate is {self.ensemble.aggregate!r}, "
                "it must be 'mean'"
            )
        return self

    @model_validator(mode="after")
    def _constrained(self) -> "Study":
        for name, limit in self.constraints.items():
            if name not in CONSTRAINTS:
                raise ValueError(unknown_key(f"constraints.{name}", name, CONSTRAINTS))
            CONSTRAINTS[name].check(f"constraints.{name}", limit)
            if self.axes and CONSTRAINTS[name].one_axis:
                raise ValueError(
                    f"constraints.{name} is known for one axis only; this stage has "
                    f"{len(self.axes.names)}"
                )
        if self.pareto and self.pareto.constraint not in self.limits:
            raise ValueError(
                f"pareto.constraint is {self.pareto.constraint!r}; "
                "it must be one of the study's constraints"
            )
        return self

    @model_validator(mode="after")
    def _timed(self) -> "Study":
        # The run of a step is as long as the references; it steps at its second sample.
        length = (round(self.references.duration * self.rate) - 1) * self.dt
        limits = [(f"constraints.{name}", name, x) for name, x in self.limits.items()]
        if self.pareto:
            name = self.pareto.constraint
            limits += [("pareto.limits", name, x) for x in self.pareto.limits]
        for key, name, limit in limits:
            kind = CONSTRAINTS[name]
            timed = kind.source == "steps" and kind.unit == "s"
            if timed and limit > length * (1.0 + 1e-9):
                raise ValueError(
                    f"{key} is {limit:g} s for the {name}; a step is simulated for "
                    f"{length:g} s only: lower the limit or raise references.duration"
                )
        return self

    @model_validator(mode="after")
    def _swept(self) -> "Study":
        known = (*self.references.tune, *self.references.unseen)
        for name in self.sweep.references if self.sweep else ():
            if name not in known:
                raise ValueError(
                    f"sweep.references: {name} is not one of the study's references, "
                    f"{', '.join(known)}"
                )
        return self

    @model_validator(mode="after")
    def _structured(self) -> "Study":
        if self.structures and self.axes:
            raise ValueError(
                f"structures are for one axis; this stage has {len(self.axes.names)}"
            )
        if self.structures and self.pareto:
            raise ValueError(
                "structures and pareto are both given; choose the structure first, "
                "then trace the front of its gains"
            )
        return self

    @model_validator(mode="after")
    def _by_axis(self) -> "Study":
        tables = {
            "references": self.references,
            "actuator": self.actuator,
            "sensor": self.sensor,
            "disturbance": self.disturbance,
        }
        lists = {
            f"{name}.{key}": value
            for name, table in tables.items()
            for key, value in table
            if not isinstance(value, NoiseFile) and key not in _OWN_LISTS
        } | {
            f"references.files.{name}.offset": trajectory.offset
            for name, trajectory in self.references.files.items()
        }
        for key, value in lists.items():
            if isinstance(value, tuple) and len(value) != self.axis_count:
                raise ValueError(
                    f"{key} holds {len(value)} values; the study has {self.axis_count} "
                    f"{'axis' if self.axis_count == 1 else 'axes'}"
                )
        return self

    @property
    def dt(self) -> float:
        """Sample time, s."""
        return 1.0 / self.rate

    @property
    def settled(self) -> int:
        """First sample of a run that counts, after ``references.settle``."""
        return round(self.references.settle * self.rate)

    @property
    def limits(self) -> dict[str, float]:
        """Limits in force by constraint: those of the study, and the defaults."""
        return limits_of(self.constraints)

    @property
    def axis_count(self) -> int:
        """Number of axes of the stage."""
        return len(self.axes.names) if self.axes else 1

    def by_axis(self, value: float | tuple[float, ...]) -> tuple[float, ...]:
        """Return the value of each axis; a single value applies to all axes."""
        return value if isinstance(value, tuple) else (value,) * self.axis_count

    def driven(self, reference: str) -> dict[str, str]:
        """Return the signals of a reference by the name of the driven axis.

        The name is "" on a stage with one axis. Each axis of a trajectory has the name
        of the trajectory as its signal. Raises ValueError for an unknown reference.
        """
        if reference in self.references.files:
            axes = self.references.files[reference].axes if self.axes else ("",)
            return dict.fromkeys(axes, reference)
        if self.axes:
            return motions.parse(reference, self.axes.names)
        signals.parse(reference)
        return {"": reference}
