"""A study file and its validation."""

from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from ..analysis.constraints import CONSTRAINTS, limits_of
from ..signals import motions
from ..signals import waveforms as signals
from .ensemble_table import EnsembleTable
from .file_tables import NoiseFile
from .reference_table import References
from .search_tables import (
    BesideTable,
    ObjectiveTable,
    OptimiserTable,
    ParetoTable,
    TunedTable,
)
from .stage_tables import Actuator, AxesTable, DisturbanceTable, SensorTable
from .structure_table import StructuresTable
from .sweep_table import SweepTable, require_quoted_paths
from .tables import Positive, Table, example, in_unit, unknown_key

NOTHING_TO_TUNE = "tune and parameters are missing; name at least one parameter to tune"
"""Message on a study without tuned parameters. One that is only swept needs none."""

_OWN_LISTS = ("tune", "unseen", "files")
"""Keys whose lists are not values by axis."""

_OWN_LOOPS = ("before", "tuned")
"""Names in a result of the loops with the start and with the tuned gains."""

MEMORY_GB = 4.0
"""Largest memory of the signals of a study, GB. Tuning takes several times as much."""


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
    named here or in ``tune``, or in ``sweep`` for a study that is only swept."""
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

    @field_validator("beside")
    @classmethod
    def _named(cls, tables: dict[str, BesideTable]) -> dict[str, BesideTable]:
        for name in _OWN_LOOPS:
            if name in tables:
                raise ValueError(
                    f"{name} is the name of a loop of the study itself; choose another"
                )
        return tables

    @model_validator(mode="after")
    def _tuned(self) -> "Study":
        swept = self.sweep is not None and self.sweep.parameters
        if not (self.tune or self.parameters or swept):
            raise ValueError(NOTHING_TO_TUNE)
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
