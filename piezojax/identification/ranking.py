"""Ranking of the models fitted to the same records."""

from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel

from .criteria import MARGIN
from .fit import Fit, FitError

RULE = (
    "lowest BIC among the models whose validation error is not above the smallest by "
    f"more than {MARGIN:g} standard errors of the difference; BIC from the training "
    "part, with the effective number of samples; of equivalent models, the one listed "
    "first"
)
"""Rule for the choice of the best model."""


RULE_ACROSS = RULE.replace(
    "validation error", "error on each record left out of the fit in turn"
)
"""Rule for several records of one input and one output."""


class RankedModel(BaseModel):
    """Errors of a model of the ranking, or the reason why it has none.

    ``parameters`` is the number of fitted parameters. ``across_rmse`` is the rms error
    over all records, each left out of a fit to the others, None for a single record and
    for a model that fails on one of them. ``validates_as_well`` tells whether the model
    validates as well as the best; ``folder`` holds its model.json and fit.json.
    """

    model: str
    status: Literal["fitted", "failed", "not tried"]
    note: str = ""
    parameters: int | None = None
    train_rmse: float | None = None
    validation_rmse: float | None = None
    validation_rmse_percent_of_span: float | None = None
    across_rmse: float | None = None
    aic: float | None = None
    bic: float | None = None
    validates_as_well: bool | None = None
    wall_s: float | None = None
    warnings: list[str] = []
    folder: str | None = None


class RankingReport(BaseModel):
    """Content of ``comparison.json``.

    ``rows`` holds the fitted models, best first, then the failed and untried ones.
    ``test`` is the error of the best model on samples used neither by a fit nor by the
    choice, None without such a part. ``effective_samples`` (of ``samples``, for each
    output) is the number that AIC and BIC count. ``across`` tells whether the models
    were compared on records left out of their fits.
    """

    best: str
    rule: str
    unit: str
    train: tuple[int, int]
    validation: tuple[int, int]
    test_part: tuple[int, int] | None
    test: FitError | None
    samples: int
    effective_samples: list[float]
    interrupted: bool
    across: bool = False
    rows: list[RankedModel]
    wall_s: float

    def error_of(self, row: RankedModel) -> float | None:
        """Return the rms error of ``row`` that the choice compared."""
        return row.across_rmse if self.across else row.validation_rmse


@dataclass(frozen=True)
class ModelRanking:
    """Fits by model, best first, and the report on them."""

    fits: dict[str, Fit]
    report: RankingReport

    @property
    def best(self) -> Fit:
        """Fit of the chosen model."""
        return self.fits[self.report.best]


def file_name(model: str) -> str:
    """Return ``model`` as the name of a folder."""
    return model.replace("+", "-")
