"""Comparison studies: several controllers and sampling rates, tuned alike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ..catalog import CONTROLLERS, at_rate
from ..core.feedback import Feedback
from ..core.paths import get
from ..core.plain import read_plain
from ..core.system import Affine
from .case import Case
from .ensemble_table import EnsembleTable
from .make_case import build, read
from .reference_table import References
from .schema import Study
from .search_tables import ObjectiveTable, OptimiserTable
from .stage_tables import DisturbanceTable, SensorTable
from .tables import Positive, RangeTable, Table, one_of, validated

Start = Literal["printed", "scaled", "rule", "own"]
"""Source of the gains before tuning.

"printed": a publication; "scaled": a publication at another rate; "rule": a published
tuning rule; "own": the study itself.
"""


class RateRange(RangeTable):
    """Bounds of a parameter at every rate; the default scale is logarithmic.

    The bounds are either ``lower`` and ``upper``, or the start divided and multiplied
    by ``factor``; a factor needs a positive start. ``per_sample`` multiplies
    ``lower`` and ``upper`` by the rate: 0.5 means half the rate, in 1/s.
    """

    per_sample: bool = False
    factor: Annotated[float, Field(gt=1, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "RateRange":
        both = self.lower is not None and self.upper is not None
        if both == (self.factor is not None):
            raise ValueError("give lower and upper, or a factor")
        if self.factor is not None and self.per_sample:
            raise ValueError(
                "per_sample multiplies lower and upper by the rate; a factor has no "
                "unit: leave per_sample out"
            )
        if self.factor is not None and self.scale not in (None, "log"):
            raise ValueError(
                f"scale is {self.scale!r}; bounds of a factor are searched on the "
                "scale 'log': leave scale out, or give lower and upper"
            )
        return self

    def at(self, start: float, rate: float, path: str) -> dict[str, Any]:
        """Return the bounds at ``rate`` (Hz) for a ``start`` value.

        Raises ValueError for a ``factor`` with a start that is not positive.
        """
        if self.lower is not None and self.upper is not None:
            unit = rate if self.per_sample else 1.0
            lower, upper = self.lower * unit, self.upper * unit
            # The bounds are widened to contain the start of every rate.
            lower, upper = min(lower, start), max(upper, start)
            return {"lower": lower, "upper": upper, "scale": self.scale or "log"}
        assert self.factor is not None
        if start <= 0.0:
            raise ValueError(
                f"{path} starts at {start:g}; a factor needs a start above 0: "
                "give lower and upper instead"
            )
        return {
            "lower": start / self.factor,
            "upper": start * self.factor,
            "scale": "log",
        }


class ControllerTable(Table):
    """A controller of a comparison, by its ``catalog`` name.

    ``rates`` are its sampling rates (Hz), by default those of the file. ``tune`` holds
    paths in the loop. ``bounds`` take precedence over the bounds of the file.
    ``printed`` are the rates (Hz) with published gains; ``elsewhere`` is the source of
    the gains at other rates. ``label`` is the name of the controller in the table of
    results.
    """

    catalog: str
    tune: tuple[str, ...] = Field(min_length=1)
    label: str | None = None
    printed: tuple[Positive, ...] = ()
    elsewhere: Start = "scaled"
    rates: tuple[Positive, ...] | None = None
    bounds: dict[str, RateRange] = Field(default_factory=dict)


class ComparisonStudy(Table):
    """Controllers and rates (Hz) that are tuned alike; each pair is a study.

    The keys of ``bounds`` are paths or patterns such as ``*.cutoff``. If several match
    a path, the longest one applies. The other tables are those of a study.
    """

    title: str
    rates: tuple[Positive, ...] = Field(min_length=1)
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    plant: dict[str, Any]
    actuator: dict[str, Any]
    sensor: SensorTable = SensorTable()
    disturbance: DisturbanceTable = DisturbanceTable()
    references: References
    objective: ObjectiveTable = ObjectiveTable()
    optimiser: OptimiserTable = OptimiserTable()
    ensemble: EnsembleTable | None = None
    constraints: dict[str, Any] = Field(default_factory=dict)
    holdout_draws: Annotated[int, Field(strict=True, ge=1, le=64)] = 1
    bounds: dict[str, RateRange] = Field(default_factory=dict)
    controllers: dict[str, ControllerTable] = Field(min_length=1)

    @model_validator(mode="after")
    def _distinct_rates(self) -> "ComparisonStudy":
        lists = {"rates": self.rates} | {
            f"controllers.{name}.rates": table.rates or ()
            for name, table in self.controllers.items()
        }
        for key, rates in lists.items():
            for rate in rates:
                if rates.count(rate) > 1:
                    raise ValueError(f"{key}: {rate:g} Hz is listed twice")
        return self


@dataclass(frozen=True)
class ComparedCase:
    """A Case of a comparison, its controller and the source of its starting gains."""

    controller: str
    case: Case
    start: Start

    @property
    def name(self) -> str:
        """Name of the case, which is also the name of its results folder."""
        return self.case.name


def read_compared(
    paths: Sequence[str | Path], seed: int | None = None
) -> tuple[str, list[ComparedCase]]:
    """Read study files and comparison study files; return their title and cases.

    Raises ValueError: one line with the key, the value and the allowed values. It is
    also raised if two cases have the same name.
    """
    titles, cases = [], []
    for path in map(Path, paths):
        if is_comparison_study(path):
            comparison = load_comparison_study(path)
            titles.append(comparison.title)
            cases += compared_cases(comparison, path, seed)
        else:
            case = read(path, seed)
            cases.append(ComparedCase(case.study.title, case, "own"))
    names = [compared.name for compared in cases]
    folded = [name.casefold() for name in names]
    for name in names:
        if folded.count(name.casefold()) > 1:
            raise ValueError(f"two studies are named {name}; each needs its own name")
    return ", ".join(titles) or "Comparison of studies", cases


def is_comparison_study(path: Path) -> bool:
    """Return whether ``path`` is a readable file with a comparison study."""
    try:
        return "controllers" in read_plain(path, "toml", str(path))
    except ValueError:
        return False


def load_comparison_study(path: str | Path) -> ComparisonStudy:
    """Read and validate a comparison study.

    Raises ValueError: one line with the key, the value and the allowed values.
    """
    data = read_plain(Path(path), "toml", f"study {path}")
    return validated(ComparisonStudy, data, "")


def compared_cases(
    comparison: ComparisonStudy, path: str | Path, seed: int | None = None
) -> list[ComparedCase]:
    """Return the case of each controller and rate.

    The files that the comparison names lie beside ``path``. Raises ValueError, naming
    the controller and the rate.
    """
    cases = []
    for name, table in comparison.controllers.items():
        for rate in table.rates or comparison.rates:
            try:
                study = _study(comparison, table, rate, table.label or name)
                file = Path(path).with_name(f"{name}_{rate:g}Hz.toml")
                case = build(study, file, seed)
            except ValueError as error:
                raise ValueError(f"{name} at {rate:g} Hz: {error}") from None
            printed = rate in table.printed
            start = "printed" if printed else table.elsewhere
            cases.append(ComparedCase(table.label or name, case, start))
    return cases


def _study(
    comparison: ComparisonStudy, table: ControllerTable, rate: float, label: str
) -> Study:
    controller = at_rate(CONTROLLERS, one_of(table.catalog, CONTROLLERS), rate)
    loop = Feedback(controller, Affine(), Affine(), Affine())
    parameters = {}
    for path in table.tune:
        bounds = _bounds(path, table.bounds) or _bounds(path, comparison.bounds)
        bounds = bounds or RateRange(factor=100.0)
        start = float(get(loop, path))
        parameters[path] = bounds.at(start, rate, path)
    shared = comparison.model_dump(
        mode="json", exclude={"rates", "bounds", "controllers"}, exclude_none=True
    )
    data = shared | {
        "title": f"{label} at {rate / 1000.0:g} kHz",
        "rate": rate,
        "controller": {"catalog": table.catalog},
        "parameters": parameters,
    }
    return validated(Study, data, "")


def _bounds(path: str, bounds: Mapping[str, RateRange]) -> RateRange | None:
    matches = [pattern for pattern in bounds if fnmatchcase(path, pattern)]
    return bounds[max(matches, key=len)] if matches else None
