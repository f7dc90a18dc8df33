"""Table ``[sweep]`` of a study: swept parameters and recorded metrics."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ..core.metrics import TrackingFigures
from .tables import Finite, RangeTable, Table, one_of

SENSITIVITY = "sensitivity_peak"
METRICS = (*TrackingFigures._fields, SENSITIVITY)
"""Metrics of a run: tracking figures, and the peak of |1/(1+L)| of the linearised
loop."""

PARTS = ("controller", "plant", "actuator", "sensor")
"""Parts of a loop; every path of a parameter starts with one of them."""

Count = Annotated[int, Field(strict=True, ge=1)]


class SweptTable(RangeTable):
    """Range of a swept parameter, or its ``values``.

    In a grid, ``count`` points are evenly spaced on the scale. Random samples need no
    count.
    """

    count: Annotated[int, Field(strict=True, ge=2)] | None = None
    values: tuple[Finite, ...] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "SweptTable":
        if self.values is not None:
            if not (self.lower is None and self.upper is None and self.count is None):
                raise ValueError("give either values, or lower and upper")
            if not self.values:
                raise ValueError("values must hold at least one number")
            if list(self.values) != sorted(set(self.values)):
                raise ValueError("values must increase")
        return self


class SweepTable(Table):
    """Points of a sweep, and the recorded metrics.

    ``method`` "grid" simulates every combination of the parameters; "latin_hypercube"
    and "sobol" draw ``samples`` points of their box. Without ``parameters`` the box is
    that of the tuned parameters. ``plants`` are names in the catalogue, by default the
    plant of the study. ``references`` are among those of the study, by default all of
    them. ``every`` records each N-th sample of displacement and voltage. ``chunk`` is
    the number of points that are simulated and stored at a time.
    """

    method: Literal["grid", "latin_hypercube", "sobol"] = "grid"
    samples: Count | None = None
    parameters: dict[str, SweptTable] = Field(default_factory=dict)
    plants: tuple[str, ...] = ()
    references: tuple[str, ...] = ()
    metrics: tuple[str, ...] = Field(
        default=("rms_error", "peak_error", "rms_effort", "saturated"), min_length=1
    )
    every: Count | None = None
    chunk: Count | None = None

    @field_validator("metrics")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(one_of(name, METRICS) for name in names)

    @field_validator("metrics", "plants", "references")
    @classmethod
    def _once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{name} is listed twice")
        return names

    @field_validator("parameters", mode="before")
    @classmethod
    def _quoted(cls, tables: Any) -> Any:
        return require_quoted_paths(tables)

    @model_validator(mode="after")
    def _consistent(self) -> "SweepTable":
        for path, parameter in self.parameters.items():
            if path.split(".")[0] not in PARTS:
                raise ValueError(
                    f"parameters.{path}: the path must start with one of "
                    f"{', '.join(PARTS)}"
                )
            if self.method == "grid":
                if parameter.values is None and parameter.count is None:
                    raise ValueError(f"parameters.{path}: a grid needs a count")
            elif parameter.values is not None or parameter.count is not None:
                raise ValueError(
                    f"parameters.{path}: {self.method} draws points between lower and "
                    "upper; leave values and count out"
                )
        if self.method == "grid" and not self.parameters:
            raise ValueError("a grid needs parameters, each with a count or values")
        if (self.samples is None) != (self.method == "grid"):
            problem = (
                "a grid takes counts, not samples"
                if self.method == "grid"
                else f"{self.method} needs samples, the number of points"
            )
            raise ValueError(problem)
        return self


def require_quoted_paths(tables: Any) -> Any:
    """Return ``tables`` unchanged, after a check that its keys are quoted paths.

    Raises ValueError for a path without quotes, which TOML splits into nested tables.
    """
    for key, table in tables.items() if isinstance(tables, dict) else ():
        if isinstance(table, dict) and any(
            isinstance(value, dict) for value in table.values()
        ):
            raise ValueError(
                f'a path must stand in quotes, as in "{key}.{next(iter(table))}"'
            )
    return tables
