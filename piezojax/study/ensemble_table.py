"""Table ``[ensemble]`` of a study: the deviations of the stage."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .tables import Finite, Positive, Table, example


class EnsembleTable(Table):
    """Random stages: relative deviations, ranges and standard errors of parameters.

    The keys of ``spread`` and ``range`` are names of deviations of the catalogued
    plant, such as ``gain``, or paths, such as ``plant.hysteresis.a`` and
    ``sensor.noise.noise_rms``.
    """

    model_config = example(
        {
            "tune": 3,
            "holdout": 200,
            "spread": {"gain": 0.2, "sensor.noise.noise_rms": 0.3},
            "range": {"mode_frequency": [2000.0, 6000.0]},
        }
    )

    spread: dict[str, Positive] = Field(default_factory=dict)
    """Largest relative deviations; values are drawn uniformly on both sides of the
    nominal one."""
    range: dict[str, tuple[Finite, Finite]] = Field(default_factory=dict)
    """Intervals, in the unit of the parameter, from which values are drawn
    uniformly."""
    standard_errors: Path | None = None
    """A ``fit.json`` of identify, whose parameters are drawn from normal distributions
    around their values, within their limits. Parameters without a standard error keep
    their values, and a note names them."""
    tune: Annotated[int, Field(strict=True, ge=0, le=64)] = 0
    """Number of drawn stages in the objective, in addition to the nominal one."""
    margins: Annotated[int, Field(strict=True, ge=0, le=1024)] = 64
    """Number of drawn stages on which margins are limited, in addition to the nominal
    one; the first of them are those of ``tune``. If there are more than 15, a search
    uses the worst ones only, and its result is checked on all."""
    holdout: Annotated[int, Field(strict=True, ge=1, le=1024)] = 50
    """Number of other stages on which the tuned gains are evaluated."""
    aggregate: Literal["mean", "worst", "cvar"] = "mean"
    """Objective of several stages: the mean of their objectives, the worst, or the mean
    over the worst share ``tail`` of the stages (CVaR)."""
    tail: Annotated[float, Field(gt=0.0, le=1.0)] = 0.25
    """Share of the stages in ``cvar``."""

    @property
    def ranges(self) -> list[str]:
        """Ranges of the drawn plants, as phrases."""
        errors = self.standard_errors
        return [
            *(f"{name} +- {100.0 * part:g} %" for name, part in self.spread.items()),
            *(
                f"{name} {low:g} to {high:g}"
                for name, (low, high) in self.range.items()
            ),
            *([f"the standard errors of {errors.name}"] if errors else []),
        ]

    @model_validator(mode="after")
    def _consistent(self) -> "EnsembleTable":
        if not (self.spread or self.range or self.standard_errors):
            raise ValueError(
                "spread, range and standard_errors are empty; give at least one of them"
            )
        for name, (low, high) in self.range.items():
            if low >= high:
                raise ValueError(
                    f"range.{name} is {low:g} to {high:g}; the first must be lower"
                )
            if name in self.spread:
                raise ValueError(f"{name} is in both spread and range")
        return self
