"""Table ``[sweep]`` of a study: swept parameters and recorded metrics."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ..core.metrics import TrackingFigures
from .tables import Finite, RangeTable, Table, example, once, one_of

SENSITIVITY = "sensitivity_peak"
METRICS = (*TrackingFigures._fields, SENSITIVITY)
"""Metrics of a run: tracking figures, and the peak of |1/(1+L)| of the linearised
loop."""

PARTS = ("controller", "plant", "actuator", "sensor")
"""Parts of a loop; every path of a parameter starts with one of them."""

Count = Annotated[int, Field(strict=True, ge=1)]


class SweptTable(RangeTable):
    """Range of a swept parameter, or its values, in the unit of the parameter.

    The declaration of the parameter supplies bounds and a scale that are left out.
    """

    model_config = example({"lower": 1.0, "upper": 200.0, "count": 31, "scale": "log"})

    count: Annotated[int, Field(strict=True, ge=2)] | None = None
    """Number of points of a grid, evenly spaced on the scale."""
    values: tuple[Finite, ...] | None = None
    """Increasing values of a grid, instead of bounds and a count."""

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
    """Points of a sweep, and the recorded metrics."""

    model_config = example(
        {
            "method": "sobol",
            "samples": 256,
            "metrics": ["rms_error", "sensitivity_peak"],
            "parameters": {
                "controller.cutoff": {"lower": 100.0, "upper": 2e4, "scale": "log"}
            },
        }
    )

    method: Literal["grid", "latin_hypercube", "sobol"] = "grid"
    """``grid`` simulates every combination of the parameters; the others draw
    ``samples`` points of their box."""
    samples: Count | None = None
    """Number of drawn points; not for a grid."""
    parameters: dict[str, SweptTable] = Field(default_factory=dict)
    """Swept parameters by path; without them the box is that of the tuned
    parameters."""
    plants: tuple[str, ...] = ()
    """Catalogued plants; without them the plant of the study."""
    references: tuple[str, ...] = ()
    """References of the study; without them all of its references."""
    metrics: tuple[str, ...] = Field(
        default=("rms_error", "peak_error", "rms_effort", "saturated"), min_length=1
    )
    """Recorded metrics: figures of a run, and the peak ``sensitivity_peak`` of
    |1/(1+L)|."""
    every: Count | None = None
    """Record every N-th sample of displacement and voltage; without this key none."""
    chunk: Count | None = None
    """Number of points that are simulated and stored at a time; without this key it is
    chosen from the length of a run."""

    @field_validator("metrics")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(one_of(name, METRICS) for name in names)

    _once = field_validator("metrics", "plants", "references")(once)

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
