"""The outcome of tuning: what ``result.json`` holds, and how it is written and read."""

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from ..metrics import TrackingFigures
from .objective import RAILED

Status = Literal["converged", "step limit", "interrupted"]

RESULT_FILE = "result.json"
GAINS_FILE = "gains.toml"


class Scores(BaseModel):
    """Tracking errors of one set of gains, um, by reference, over all noise draws."""

    per_reference_rms_um: dict[str, float | None]
    geomean_rms_um: float | None
    worst_rms_um: float | None
    peak_error_um: dict[str, float | None]
    saturated_percent: dict[str, float]
    peak_voltage_V: float | None  # noqa: N815

    @property
    def stable(self) -> bool:
        """Whether every run stayed finite and off the limits most of the time."""
        railed = max(self.saturated_percent.values()) > 100.0 * RAILED
        return self.geomean_rms_um is not None and not railed


class Perturbed(BaseModel):
    """The same gains on ``plants`` off their nominal values, drawn for the hold-out.

    ``unstable`` counts plants on which a run diverges or rails. ``median_better`` and
    ``worst_better`` are how many times smaller the geometric mean of the errors of the
    driven axes is than before, on the plant in the middle and on the worst one, None
    where a loop is unstable; ``coupling_better`` is the median of the axes at rest.
    """

    plants: int
    unstable_before: int
    unstable: int
    geomean_rms_um: float | None
    worst_rms_um: float | None
    median_better: float | None
    worst_better: float | None
    coupling_better: float | None

    @classmethod
    def of(
        cls, before: TrackingFigures, after: TrackingFigures, driven: np.ndarray
    ) -> "Perturbed":
        """Return what figures [plant, trace, draw] before and after tuning come to."""
        means, lost = [], []
        for figures in (before, after):
            rms = np.sqrt(np.mean(np.asarray(figures.rms_error) ** 2, axis=2))
            railed = np.max(np.asarray(figures.saturated), axis=(1, 2)) > RAILED
            lost.append(railed | ~np.all(np.isfinite(rms), axis=1))
            with np.errstate(divide="ignore"):
                means.append(np.log(rms))
        usable = ~lost[0] & ~lost[1]
        better = np.exp(np.mean((means[0] - means[1])[usable][:, driven], axis=1))
        rest = (means[0] - means[1])[usable][:, ~driven]
        errors = np.exp(np.mean(means[1][~lost[1]][:, driven], axis=1))
        return cls(
            plants=len(usable),
            unstable_before=int(lost[0].sum()),
            unstable=int(lost[1].sum()),
            geomean_rms_um=_number(np.median(errors)) if errors.size else None,
            worst_rms_um=_number(errors.max()) if errors.size else None,
            median_better=_number(np.median(better)) if better.size else None,
            worst_better=_number(better.min()) if better.size else None,
            coupling_better=(
                _number(np.median(np.exp(np.mean(rest, axis=1)))) if rest.size else None
            ),
        )


class Result(BaseModel):
    """Everything a tuning run found; ``result.json`` is this as JSON.

    ``before`` and ``after`` are the study's own gains and the tuned ones on the tuning
    references and draws; ``holdout_before`` and ``holdout`` are the same two on noise
    the optimiser has not seen, and ``unseen_before`` and ``unseen`` on references it
    has not seen, with that noise too. On a stage with several axes these are the driven
    ones, each error in its own unit of ``units``; ``coupling_before`` and ``coupling``
    are the axes that should rest, under all references of the hold-out. ``history``
    holds the lowest loss of each start after each step, ``times_s`` the seconds from
    the begin of the search to the end of that step. ``perturbed``
    says how the gains do on the plants of the study's ensemble.
    """

    model_config = ConfigDict(extra="ignore")

    study: str
    title: str
    status: Status
    method: str
    gains: dict[str, float]
    start: dict[str, float]
    at_bound: list[str]
    before: Scores
    after: Scores
    holdout_before: Scores
    holdout: Scores
    unseen_before: Scores | None
    unseen: Scores | None
    coupling_before: Scores | None = None
    coupling: Scores | None = None
    perturbed: Perturbed | None = None
    units: dict[str, str] = {}
    warnings: list[str]
    history: list[list[float | None]]
    times_s: list[float] = []
    evaluations: int
    compile_s: float
    wall_s: float
    versions: dict[str, str]
    seed: int


def scores(figures: TrackingFigures, names: tuple[str, ...]) -> Scores:
    """Return the Scores of figures of shape [reference, draw]."""
    rms = np.sqrt(np.mean(np.asarray(figures.rms_error) ** 2, axis=1))
    peak = np.max(np.asarray(figures.peak_error), axis=1)
    saturated = 100.0 * np.mean(np.asarray(figures.saturated), axis=1)
    finite = bool(np.all(np.isfinite(rms)))
    voltage = float(np.max(np.asarray(figures.peak_voltage)))
    return Scores(
        per_reference_rms_um=dict(zip(names, map(_number, rms), strict=True)),
        geomean_rms_um=_number(np.exp(np.mean(np.log(rms)))) if finite else None,
        worst_rms_um=_number(np.max(rms)) if finite else None,
        peak_error_um=dict(zip(names, map(_number, peak), strict=True)),
        saturated_percent={
            name: float(share) for name, share in zip(names, saturated, strict=True)
        },
        peak_voltage_V=_number(voltage),
    )


def _number(value: float) -> float | None:
    # JSON has no infinity: a run that diverged has no figure.
    return float(value) if np.isfinite(value) else None


def load_result(path: str | Path) -> Result:
    """Read a ``result.json``, or the folder that holds one.

    Raises ValueError if there is none or it is damaged.
    """
    path = Path(path)
    path = path / RESULT_FILE if path.is_dir() else path
    try:
        return Result.model_validate_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except ValidationError as error:
        raise ValueError(
            f"{path} is no result of tuning: {error.errors()[0]['msg']}"
        ) from None
