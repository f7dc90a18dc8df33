"""Several studies that end in one comparison: from one file, or from a file each."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ..catalog import CONTROLLERS, at_rate
from ..core.parameter import Scale
from ..core.paths import get
from .case import Case, build, read
from .schema import ObjectiveTable, OptimiserTable, References, Study
from .stage_tables import SensorTable
from .tables import Finite, Positive, Table, one_of, validated

Start = Literal["printed", "scaled", "rule", "own"]
"""Where the gains before tuning come from: a publication, a publication at another
rate, a published rule of tuning by hand, or the study itself."""


class Range(Table):
    """Bounds of a parameter at every rate.

    Either ``lower`` and ``upper``, with ``per_sample`` in units of the rate (so that
    0.5 is half of it in 1/s), or a ``factor`` to either side of the start, which must
    not be zero; a factor's scale is always logarithmic.
    """

    lower: Finite | None = None
    upper: Finite | None = None
    scale: Scale = "log"
    per_sample: bool = False
    factor: Annotated[float, Field(gt=1, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "Range":
        both = self.lower is not None and self.upper is not None
        if both == (self.factor is not None):
            raise ValueError("it takes lower and upper, or a factor")
        return self

    def at(self, start: float, rate: float, path: str) -> dict[str, Any]:
        """Return the bounds of a study at ``rate`` (Hz) for a ``start`` value."""
        if self.lower is not None and self.upper is not None:
            unit = rate if self.per_sample else 1.0
            lower, upper = self.lower * unit, self.upper * unit
            # Bounds hold the starts of all rates: they are wide, not judged.
            lower, upper = min(lower, start), max(upper, start)
            return {"lower": lower, "upper": upper, "scale": self.scale}
        assert self.factor is not None
        if start <= 0.0:
            raise ValueError(
                f"{path} starts at {start:g}; a factor takes a start above 0, "
                "give it lower and upper"
            )
        return {
            "lower": start / self.factor,
            "upper": start * self.factor,
            "scale": "log",
        }


class Contender(Table):
    """A controller by its ``catalog`` name, tuned at ``rates`` (those of the file).

    ``tune`` are paths in the controller; ``bounds`` go before the file's. ``printed``
    are the rates (Hz) whose gains are published, ``elsewhere`` is where those of the
    others come from; ``label`` is its name in the table.
    """

    catalog: str
    tune: tuple[str, ...] = Field(min_length=1)
    label: str | None = None
    printed: tuple[Positive, ...] = ()
    elsewhere: Start = "scaled"
    rates: tuple[Positive, ...] | None = None
    bounds: dict[str, Range] = Field(default_factory=dict)


class Comparison(Table):
    """Controllers and rates (Hz) that are tuned alike, each pair a study of its own.

    ``bounds`` go by the end of a parameter's path, the longest that fits; ``default``
    is for all others. The other tables are those of a study.
    """

    title: str
    rates: tuple[Positive, ...] = Field(min_length=1)
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    plant: dict[str, Any]
    actuator: dict[str, Any]
    sensor: SensorTable = SensorTable()
    references: References
    objective: ObjectiveTable = ObjectiveTable()
    optimiser: OptimiserTable = OptimiserTable()
    holdout_draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 1
    bounds: dict[str, Range] = Field(default_factory=dict)
    controllers: dict[str, Contender] = Field(min_length=1)

    @model_validator(mode="after")
    def _rates_once(self) -> "Comparison":
        for name, contender in self.controllers.items():
            for rates in (self.rates, contender.rates or ()):
                if len(set(rates)) < len(rates):
                    raise ValueError(f"the rates of {name} hold one of them twice")
        return self


@dataclass(frozen=True)
class Entry:
    """A case of a comparison: who it is, and where its gains before tuning are from."""

    controller: str
    case: Case
    start: Start

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.case.name


def read_entries(
    paths: Sequence[str | Path], seed: int | None = None
) -> tuple[str, list[Entry]]:
    """Return the title and the entries of studies and comparisons in files.

    Raises ValueError, one line naming the key, the value and what is allowed, and for
    two entries of one name.
    """
    titles, entries = [], []
    for path in map(Path, paths):
        if is_comparison(path):
            comparison = load_comparison(path)
            titles.append(comparison.title)
            entries += entries_of(comparison, path, seed)
        else:
            case = read(path, seed)
            entries.append(Entry(case.study.title, case, "own"))
    names = [entry.name for entry in entries]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two studies are named {name}; each takes its own name")
    return ", ".join(titles) or "Comparison of studies", entries


def is_comparison(path: Path) -> bool:
    """Return whether the file ``path`` is a comparison; a damaged one is none."""
    try:
        return "controllers" in tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def load_comparison(path: str | Path) -> Comparison:
    """Read and validate a comparison. Raises ValueError as ``load`` of a study does."""
    data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    return validated(Comparison, data, "")


def entries_of(
    comparison: Comparison, path: str | Path, seed: int | None = None
) -> list[Entry]:
    """Return an Entry for each controller and rate; files in it lie beside ``path``."""
    entries = []
    for name, contender in comparison.controllers.items():
        for rate in contender.rates or comparison.rates:
            try:
                study = _study(comparison, contender, rate, contender.label or name)
                file = Path(path).with_name(f"{name}_{rate:g}Hz.toml")
                case = build(study, file, seed)
            except ValueError as error:
                raise ValueError(f"{name} at {rate:g} Hz: {error}") from None
            printed = rate in contender.printed
            start = "printed" if printed else contender.elsewhere
            entries.append(Entry(contender.label or name, case, start))
    return entries


def _study(
    comparison: Comparison, contender: Contender, rate: float, label: str
) -> Study:
    controller = at_rate(CONTROLLERS, one_of(contender.catalog, CONTROLLERS), rate)
    parameters = {}
    for path in contender.tune:
        bounds = _bounds(path, contender.bounds) or _bounds(path, comparison.bounds)
        if bounds is None:
            bounds = comparison.bounds.get("default", Range(factor=100.0))
        start = float(get(controller, path))
        parameters[f"controller.{path}"] = bounds.at(start, rate, path)
    shared = comparison.model_dump(
        mode="json", exclude={"rates", "bounds", "controllers"}, exclude_none=True
    )
    data = shared | {
        "title": f"{label} at {rate / 1000.0:g} kHz",
        "rate": rate,
        "controller": {"catalog": contender.catalog},
        "parameters": parameters,
    }
    return validated(Study, data, "")


def _bounds(path: str, bounds: Mapping[str, Range]) -> Range | None:
    fits = [end for end in bounds if f".{path}".endswith(f".{end}")]
    return bounds[max(fits, key=len)] if fits else None
