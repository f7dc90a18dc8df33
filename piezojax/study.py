"""The study file: what to tune, on what, how; validated before anything runs."""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from . import signals
from .catalog import CONTROLLERS, PLANTS
from .control.design import DESIGNS
from .hardware import Quantiser, Saturation, Sensor, SlewLimit
from .identify import MODELS, Fit, identify, read_record
from .optimisers import METHODS
from .paths import replace
from .serial import from_data
from .serial import load as load_system
from .space import Space, Transform, space_of
from .system import Feedback, System, series

DEFAULT = "p753_dob"
"""Name of the study that runs when none is given."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Table(BaseModel):
    """A table of a study: nothing in it is guessed, nothing unknown is passed over."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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
        return _one_of(name, MODELS)


class References(Table):
    """Signals to follow: names, um, s. ``unseen`` are kept from the optimiser."""

    tune: tuple[str, ...] = Field(min_length=1)
    unseen: tuple[str, ...] = ()
    amplitude: Positive = 5.0
    offset: Finite = 0.0
    duration: Positive = 1.0
    settle: NotNegative = 0.5

    @field_validator("tune", "unseen")
    @classmethod
    def _signals(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            signals.parse(name)
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

    lower: Finite
    upper: Finite
    slew_rate: Positive | None = None
    resolution: Positive | None = None


class SensorTable(Table):
    """Noise and resolution of the sensor, um."""

    noise_rms: NotNegative = 0.0


class ObjectiveTable(Table):
    """What is minimised; see piezojax.tune.objective.Objective."""

    aggregate: Literal["geometric_mean", "mean_square", "worst"] = "geometric_mean"
    effort_weight: NotNegative = 0.0
    slew_weight: NotNegative = 0.0
    noise_draws: Annotated[int, Field(ge=1, le=64)] = 1


class OptimiserTable(Table):
    """How it is minimised.

    ``candidates`` points of the box are simulated, the best become ``starts`` together
    with the study's own start, and each takes up to ``steps`` steps.
    """

    method: str = "bfgs"
    starts: Annotated[int, Field(ge=1, le=256)] = 8
    candidates: Annotated[int, Field(ge=0, le=65536)] = 64
    steps: Annotated[int, Field(ge=1, le=10000)] = 60
    tolerance: Positive = 1e-4

    @field_validator("method")
    @classmethod
    def _known(cls, name: str) -> str:
        return _one_of(name, METHODS)


class Study(Table):
    """A whole study; README and tuning/ show examples."""

    title: str
    rate: Positive
    seed: Annotated[int, Field(ge=0)] = 0
    plant: dict[str, Any]
    actuator: Actuator
    sensor: SensorTable = SensorTable()
    controller: dict[str, Any]
    references: References
    parameters: dict[str, Bounds] = Field(min_length=1)
    objective: ObjectiveTable = ObjectiveTable()
    optimiser: OptimiserTable = OptimiserTable()
    holdout_draws: Annotated[int, Field(ge=1, le=64)] = 1

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

    @property
    def dt(self) -> float:
        """Sample time, s."""
        return 1.0 / self.rate


class Case:
    """A study with its files read, its plant fitted and its loop built."""

    def __init__(self, study: Study, folder: Path, name: str):
        self.study, self.name = study, name
        self.fit: Fit | None = None
        plant = self._plant(folder)
        controller = _choice(
            study.controller,
            "controller",
            folder,
            CONTROLLERS,
            design=lambda key: DESIGNS[_one_of(key, DESIGNS)](plant, study.dt),
        )
        self.loop = Feedback(controller, plant, self._actuator(), self._sensor())
        self.space = self._space()
        self._check_rates()

    def _plant(self, folder: Path) -> System:
        table = self.study.plant
        if "record" not in table:
            return _choice(table, "plant", folder, PLANTS)
        wanted = _validated(RecordPlant, table, "plant")
        record = read_record(
            folder / wanted.record,
            time=wanted.time,
            input=wanted.input,
            output=wanted.output,
            rate=wanted.record_rate,
        )
        train = slice(*wanted.train) if wanted.train else None
        self.fit = identify(record, wanted.model, train=train)
        return self.fit.system

    def _actuator(self) -> System:
        table = self.study.actuator
        parts: dict[str, System] = {"limits": Saturation(table.lower, table.upper)}
        if table.slew_rate is not None:
            parts["slew"] = SlewLimit(table.slew_rate, self.study.dt)
        if table.resolution is not None:
            parts["converter"] = Quantiser(table.resolution)
        return parts["limits"] if len(parts) == 1 else series(**parts)

    def _sensor(self) -> System:
        return Sensor(self.study.sensor.noise_rms)

    def _space(self) -> Space:
        bounds = self.study.parameters
        for path, _b in bounds.items():
            if path.partition(".")[0] not in ("controller",):
                raise ValueError(
                    f"parameters.{path}: only what lies under controller can be tuned"
                )
        starts = {p: b.start for p, b in bounds.items() if b.start is not None}
        self.loop = replace(self.loop, starts)
        space = space_of(
            {p: (b.lower, b.upper, b.transform) for p, b in bounds.items()}
        )
        space.start(self.loop)
        return space

    def _check_rates(self) -> None:
        nyquist = np.pi * self.study.rate
        for path, bound in self.study.parameters.items():
            if path.endswith("cutoff") and bound.upper >= nyquist:
                raise ValueError(
                    f"parameters.{path}.upper is {bound.upper:g} rad/s; it must be "
                    f"below the Nyquist frequency, {nyquist:g} rad/s"
                )
        for dt in _sample_times(self.loop):
            if not np.isclose(dt, self.study.dt, rtol=1e-9):
                raise ValueError(
                    f"rate is {self.study.rate:g} Hz, but the controller or plant was "
                    f"made for {1.0 / dt:g} Hz"
                )


def _sample_times(system: Any) -> list[float]:
    import equinox as eqx
    import jax

    nodes = jax.tree.leaves(
        system,
        is_leaf=lambda node: isinstance(node, eqx.Module) and hasattr(node, "dt"),
    )
    return [node.dt for node in nodes if hasattr(node, "dt")]


def _choice(
    table: dict[str, Any], where: str, folder: Path, catalog: dict, design=None
) -> System:
    """Build the System that exactly one of catalog, file, type (and design) names."""
    ways = {
        "catalog": lambda: catalog[_one_of(table["catalog"], catalog)](),
        "file": lambda: load_system(folder / str(table["file"])),
        "type": lambda: from_data(table, where),
    }
    if design is not None:
        ways["design"] = lambda: design(table["design"])
    given = [way for way in ways if way in table]
    extra = [key for key in table if key not in ways] if "type" not in table else []
    if len(given) != 1 or extra:
        allowed = ", ".join([*ways, *(["record"] if where == "plant" else [])])
        raise ValueError(
            f"{where} has the keys {', '.join(table) or 'none'}; "
            f"it must have exactly one of {allowed}"
        )
    try:
        return ways[given[0]]()
    except ValueError as error:
        prefix = "" if str(error).startswith(where) else f"{where}.{given[0]}: "
        raise ValueError(f"{prefix}{error}") from None


def _one_of(name: str, allowed: Any) -> str:
    if name not in allowed:
        raise ValueError(f"{name!r} is unknown; there are {', '.join(allowed)}")
    return name


def _validated(kind: type[Any], data: Any, where: str) -> Any:
    """Return ``data`` as ``kind``; one line naming key, value and what is allowed."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise ValueError(_first_line(error, kind, where)) from None


def _first_line(error: ValidationError, kind: type[BaseModel], where: str) -> str:
    first = error.errors()[0]
    key = ".".join([where, *(str(part) for part in first["loc"])]).strip(".")
    if first["type"] == "extra_forbidden":
        table: Any = kind
        for part in first["loc"][:-1]:
            field = getattr(table, "model_fields", {}).get(part)
            table = field.annotation if field else Bounds
        known = list(getattr(table, "model_fields", Bounds.model_fields))
        near = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        return f"{key} is unknown; allowed are {', '.join(known)}{hint}"
    if first["type"] == "missing":
        return f"{key} is missing"
    message = first["msg"].removeprefix("Value error, ")
    value = first["input"]
    shown = f" is {value!r}" if isinstance(value, str | int | float) else ""
    return f"{key}{shown}: {message}"


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
    return _validated(Study, data, "")


def build(study: Study, path: str | Path, seed: int | None = None) -> Case:
    """Return ``study`` with its files read, its plant fitted and its loop built.

    Files named in it lie beside ``path``. Raises ValueError as ``load`` does.
    """
    path = Path(path)
    if seed is not None:
        study = study.model_copy(update={"seed": seed})
    return Case(study, path.parent, path.stem)


def read(path: str | Path, seed: int | None = None) -> Case:
    """Load and build the study in the file ``path``."""
    return build(load(path), path, seed)


def shipped(name: str = DEFAULT) -> Path:
    """Return the path of a study that comes with piezojax.

    Raises ValueError, listing them, for a name that is none.
    """
    here = Path(__file__).parent
    # In an installed package the studies lie inside it, in a checkout beside it.
    folder = here / "studies" if (here / "studies").is_dir() else here.parent / "tuning"
    path = folder / f"{name}.toml"
    if not path.is_file():
        known = sorted(file.stem for file in folder.glob("*.toml"))
        raise ValueError(f"study {name!r} is unknown; there are {', '.join(known)}")
    return path
