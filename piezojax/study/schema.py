"""The tables of a study file, validated before anything is built."""

import difflib
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from .. import motions, signals
from ..identify import chain
from ..optimisers import GAUSS_NEWTON, METHODS
from ..space import Transform

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


class Table(BaseModel):
    """A table of a study: nothing in it is guessed, nothing unknown is passed over."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Each = TypeVar("Each")
ByAxis = Each | tuple[Each, ...]
"""One value for all axes, or a list with one for each."""


class AxesTable(Table):
    """Names and units of the axes of a stage with several."""

    names: tuple[str, ...] = Field(min_length=2)
    units: tuple[str, ...]

    @model_validator(mode="after")
    def _consistent(self) -> "AxesTable":
        if len(self.units) != len(self.names) or len(set(self.names)) < len(self.names):
            raise ValueError("names must differ and have one unit each")
        for unit in self.units:
            one_of(unit, ("um", "urad"))
        for name in self.names:
            if not name.isidentifier():
                raise ValueError(f"axis {name!r}: a name is letters, digits and _")
        return self


class RecordPlant(Table):
    """A plant fitted to a record: columns by name or number, parts in samples."""

    record: Path
    model: str
    time: str | int | None = None
    input: str | int = 0
    output: str | int = 1
    record_rate: Positive | None = None
    train: tuple[int, int] | None = None

    @field_validator("model")
    @classmethod
    def _known(cls, name: str) -> str:
        chain(name)
        return name


class References(Table):
    """Signals to follow: names, um, s. ``unseen`` are kept from the optimiser."""

    tune: tuple[str, ...] = Field(min_length=1)
    unseen: tuple[str, ...] = ()
    amplitude: ByAxis[Positive] = 5.0
    offset: ByAxis[Finite] = 0.0
    duration: Positive = 1.0
    settle: NotNegative = 0.5

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
        return self


class Bounds(Table):
    """Bounds of a tuned parameter, in its own unit; ``start`` replaces its value."""

    lower: Finite
    upper: Finite
    transform: Transform = "linear"
    start: Finite | None = None


class Actuator(Table):
    """Limits of the drive, V and V/s; ``resolution`` of its converter, V."""

    lower: ByAxis[Finite]
    upper: ByAxis[Finite]
    slew_rate: Positive | None = None
    resolution: Positive | None = None

    @model_validator(mode="after")
    def _ordered(self) -> "Actuator":
        if np.ndim(self.lower) != np.ndim(self.upper):
            raise ValueError("lower and upper must both be lists, or neither")
        pairs = zip(np.ravel(self.lower), np.ravel(self.upper), strict=False)
        for lower, upper in pairs:
            if lower >= upper:
                raise ValueError(
                    f"lower is {lower:g} V and upper {upper:g} V; "
                    "lower must be below upper"
                )
        return self


class SensorTable(Table):
    """Noise and resolution of the sensor, um."""

    noise_rms: ByAxis[NotNegative] = 0.0
    resolution: Positive | None = None


class ObjectiveTable(Table):
    """What is minimised; see piezojax.tune.objective.Objective."""

    aggregate: Literal["geometric_mean", "mean_square", "worst"] = "geometric_mean"
    coupling_weight: NotNegative = 1.0
    effort_weight: NotNegative = 0.0
    slew_weight: NotNegative = 0.0
    noise_draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 1


class EnsembleTable(Table):
    """Plants off their nominal values, drawn evenly within ``spread`` to both sides.

    ``spread`` holds relative deviations by the names that the catalogued plant gives
    them. ``tune`` draws take part in the objective beside the nominal plant; on
    ``holdout`` others the gains are judged.
    """

    spread: dict[str, Positive] = Field(min_length=1)
    tune: Annotated[int, Field(strict=True, ge=0, le=64)] = 0
    holdout: Annotated[int, Field(strict=True, ge=1, le=1024)] = 50


class OptimiserTable(Table):
    """How it is minimised.

    ``candidates`` points of the box are simulated, the best become ``starts`` together
    with the study's own start, and each takes up to ``steps`` steps.
    """

    method: str = "bfgs"
    starts: Annotated[int, Field(strict=True, ge=1, le=256)] = 8
    candidates: Annotated[int, Field(strict=True, ge=0, le=65536)] = 64
    steps: Annotated[int, Field(strict=True, ge=1, le=10000)] = 60
    tolerance: Positive = 1e-4

    @field_validator("method")
    @classmethod
    def _known(cls, name: str) -> str:
        return one_of(name, (*METHODS, GAUSS_NEWTON))


class Study(Table):
    """A whole study; README and tuning/ show examples."""

    title: str
    rate: Positive
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    axes: AxesTable | None = None
    plant: dict[str, Any]
    actuator: Actuator
    sensor: SensorTable = SensorTable()
    controller: dict[str, Any]
    references: References
    parameters: dict[str, Bounds] = Field(min_length=1)
    objective: ObjectiveTable = ObjectiveTable()
    optimiser: OptimiserTable = OptimiserTable()
    ensemble: EnsembleTable | None = None
    holdout_draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 1

    @field_validator("parameters", mode="before")
    @classmethod
    def _quoted(cls, tables: Any) -> Any:
        for key, table in tables.items() if isinstance(tables, dict) else ():
            if isinstance(table, dict) and any(
                isinstance(value, dict) for value in table.values()
            ):
                raise ValueError(
                    f'a path must stand in quotes, as in "{key}.{next(iter(table))}"'
                )
        return tables

    @model_validator(mode="after")
    def _sampled(self) -> "Study":
        table = self.references
        samples = round(table.duration * self.rate)
        if samples < 2:
            raise ValueError(
                f"references.duration is {table.duration:g} s, {samples} samples; "
                "it takes 2 or more"
            )
        for name in (*table.tune, *table.unseen):
            try:
                driven = self.driven(name)
            except ValueError as error:
                part = "tune" if name in table.tune else "unseen"
                raise ValueError(f"references.{part}: {error}") from None
            for kind in driven.values():
                frequency = signals.parse(kind)[1] or 0.0
                if frequency >= 0.5 * self.rate:
                    raise ValueError(
                        f"references: {name} is not below half the rate, "
                        f"{0.5 * self.rate:g} Hz"
                    )
        if round(table.settle * self.rate) >= samples:
            raise ValueError(
                f"references.settle is {table.settle:g} s; no sample is left after it"
            )
        return self

    @model_validator(mode="after")
    def _least_squares(self) -> "Study":
        least_squares = self.optimiser.method == "levenberg_marquardt"
        if least_squares and self.objective.aggregate != "mean_square":
            raise ValueError(
                "optimiser.method levenberg_marquardt minimises squares; "
                f"objective.aggregate is {self.objective.aggregate!r}, "
                "it must be 'mean_square'"
            )
        return self

    @model_validator(mode="after")
    def _by_axis(self) -> "Study":
        lists = {
            "references.amplitude": self.references.amplitude,
            "references.offset": self.references.offset,
            "actuator.lower": self.actuator.lower,
            "actuator.upper": self.actuator.upper,
            "sensor.noise_rms": self.sensor.noise_rms,
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
    def axis_count(self) -> int:
        """Number of axes of the stage."""
        return len(self.axes.names) if self.axes else 1

    @property
    def highest(self) -> float | tuple[float, ...]:
        """Offset and amplitude together, of each axis."""
        table = self.references
        values = zip(
            self.by_axis(table.offset), self.by_axis(table.amplitude), strict=True
        )
        tops = tuple(offset + amplitude for offset, amplitude in values)
        return tops if self.axes else tops[0]

    def by_axis(self, value: float | tuple[float, ...]) -> tuple[float, ...]:
        """Return one value for each axis."""
        return value if isinstance(value, tuple) else (value,) * self.axis_count

    def driven(self, reference: str) -> dict[str, str]:
        """Return the signal on each driven axis of a reference, by the axis' name.

        The name is "" on a stage with one axis. Raises ValueError for an unknown one.
        """
        if self.axes:
            return motions.parse(reference, self.axes.names)
        signals.parse(reference)
        return {"": reference}


def one_of(name: str, allowed: Any) -> str:
    """Return ``name``; raise ValueError, listing ``allowed``, if it is not in there."""
    if not isinstance(name, str) or name not in allowed:
        raise ValueError(f"{name!r} is unknown; there are {', '.join(allowed)}")
    return name


def validated(kind: type[Any], data: Any, where: str) -> Any:
    """Return ``data`` as ``kind``; one line naming key, value and what is allowed."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise ValueError(_first_line(error, kind, where)) from None


_UNION = re.compile(r"(constrained-)?(float|tuple\[.*)$")
"""What pydantic adds to a place where a field takes one of several kinds."""


def _first_line(error: ValidationError, kind: type[BaseModel], where: str) -> str:
    # Of a field that takes a number or a list, the error that fits what was given.
    first = min(error.errors(), key=lambda found: isinstance(found["input"], list))
    place = [str(part) for part in first["loc"] if not _UNION.match(str(part))]
    key = ".".join([where, *place]).strip(".")
    if first["type"] == "extra_forbidden":
        table: Any = kind
        for part in first["loc"][:-1]:
            field = getattr(table, "model_fields", {}).get(part)
            inner = get_args(table)[-1] if get_args(table) else Bounds
            table = field.annotation if field else inner
        known = list(getattr(table, "model_fields", Bounds.model_fields))
        near = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        return f"{key} is unknown; allowed are {', '.join(known)}{hint}"
    if first["type"] == "missing":
        return f"{key} is missing"
    message = first["msg"].removeprefix("Value error, ")
    value = first["input"]
    shown = f" is {value!r}" if isinstance(value, str | int | float) else ""
    return f"{key}{shown}: {message}" if key else message


def load(path: str | Path) -> Study:
    """Read and validate a study file, without building anything.

    Raises ValueError, one line naming the key, the value and what is allowed.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"study {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"study {path} is no TOML file: {error}") from None
    return validated(Study, data, "")
