"""Tables of a study about the search: what is tuned, for which objective, and how."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ..analysis.constraints import CONSTRAINTS
from ..solve.optimisers import GAUSS_NEWTON, METHODS
from .sweep_table import require_quoted_paths
from .tables import Finite, NotNegative, Positive, RangeTable, Table, example, one_of


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
