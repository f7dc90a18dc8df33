"""The table of a study that says how its plants deviate."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .tables import Finite, Positive, Table


class EnsembleTable(Table):
    """Plants off their nominal values: relative deviations, ranges, standard errors.

    ``spread`` draws relative deviations evenly to both sides, ``range`` values evenly
    between two ends, both by the names that the catalogued plant gives them, or by path
    (``plant.hysteresis.a``, ``sensor.noise.noise_rms``). ``standard_errors`` draws the
    parameters of an identified plant around their values, with the standard errors in
    the named ``fit.json``.

    ``tune`` draws take part in the objective beside the nominal plant; margins are
    kept on these and on as many more as make ``margins``, which is cheap; on
    ``holdout`` others the gains are judged. ``aggregate`` joins the plants of the
    objective: their mean, the worst, or the mean of the worst ``tail`` of them (CVaR).
    """

    spread: dict[str, Positive] = Field(default_factory=dict)
    range: dict[str, tuple[Finite, Finite]] = Field(default_factory=dict)
    standard_errors: Path | None = None
    tune: Annotated[int, Field(strict=True, ge=0, le=64)] = 0
    margins: Annotated[int, Field(strict=True, ge=0, le=1024)] = 64
    holdout: Annotated[int, Field(strict=True, ge=1, le=1024)] = 50
    aggregate: Literal["mean", "worst", "cvar"] = "mean"
    tail: Annotated[float, Field(gt=0.0, le=1.0)] = 0.25

    @model_validator(mode="after")
    def _consistent(self) -> "EnsembleTable":
        if not (self.spread or self.range or self.standard_errors):
            raise ValueError(
                "one of spread, range, standard_errors must name something"
            )
        for name, (low, high) in self.range.items():
            if low >= high:
                raise ValueError(
                    f"range.{name} is {low:g} to {high:g}; the first must be lower"
                )
            if name in self.spread:
                raise ValueError(f"{name} is in both spread and range")
        return self
