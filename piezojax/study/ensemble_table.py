"""Table ``[ensemble]`` of a study: the deviations of the stage."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .tables import Finite, Positive, Table


class EnsembleTable(Table):
    """Random stages: relative deviations, ranges and standard errors of parameters.

    ``spread`` holds the largest relative deviations; values are drawn uniformly on both
    sides of the nominal one. ``range`` holds intervals, from which values are drawn
    uniformly. The keys of both are deviations of the catalogued plant or paths
    (``plant.hysteresis.a``, ``sensor.noise.noise_rms``). ``standard_errors`` names a
    ``fit.json``, whose parameters are drawn from normal distributions around their
    values.

    The objective includes the nominal stage and ``tune`` drawn stages. Margins are
    limited on the nominal stage and on ``margins`` drawn ones, the first of which are
    those of ``tune``: a search uses the worst, and all are checked at its end. The
    tuned gains are evaluated on ``holdout`` other stages. ``aggregate`` combines the
    objectives of the stages: their mean, the worst, or the mean of the worst share
    ``tail`` (CVaR).
    """

    spread: dict[str, Positive] = Field(default_factory=dict)
    range: dict[str, tuple[Finite, Finite]] = Field(default_factory=dict)
    standard_errors: Path | None = None
    tune: Annotated[int, Field(strict=True, ge=0, le=64)] = 0
    margins: Annotated[int, Field(strict=True, ge=0, le=1024)] = 64
    holdout: Annotated[int, Field(strict=True, ge=1, le=1024)] = 50
    aggregate: Literal["mean", "worst", "cvar"] = "mean"
    tail: Annotated[float, Field(gt=0.0, le=1.0)] = 0.25

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
