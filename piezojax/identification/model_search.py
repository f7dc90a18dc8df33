"""Search for a model: fits, their errors on other records, and their ranking."""

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..core.progress import Progress
from .across import errors_across
from .candidates import Candidate, parts_at
from .criteria import Criteria, criteria, effective_samples, first_equivalent, ranking
from .estimators.estimate import Options
from .fit import Fit
from .make_fit import identify
from .ranking import RankedModel
from .records.record import Record
from .unfinished import Finished, Unfinished


class _LabelledProgress:
    """Progress whose stages are labelled with the number and name of the model."""

    def __init__(self, progress: Progress, label: str):
        self._progress, self._label = progress, label

    def stage(self, text: str, steps: int = 0) -> None:
        self._progress.stage(f"{self._label}: {text}", steps)

    def advance(self, best: float, note: str = "") -> None:
        self._progress.advance(best, note)


class Search:
    """Search state: fits, failed models and waiting candidates.

    ``fitted`` is called after each fit and each evaluation on other records.
    ``left_out`` are the records that are left out of a fit in turn; if there are none,
    the validation part decides. ``across`` holds the errors on them by model, None for
    a model that fails on one of them. ``unfinished`` stores finished fits in files, so
    that a later search can continue from them; None stores none.
    """

    def __init__(
        self,
        records: Sequence[Record],
        train: slice,
        validate: slice,
        options: Options,
        progress: Progress,
    ):
        self.records, self.train, self.validate = records, train, validate
        self._options, self._progress = options, progress
        self.fits: dict[str, Fit] = {}
        self.failed: list[RankedModel] = []
        self.waiting: list[Candidate] = []
        self.left_out: tuple[Record, ...] = ()
        self.across: dict[str, tuple[np.ndarray, ...] | None] = {}
        self.fitted: Callable[[], None] = lambda: None
        self.unfinished: Unfinished | None = None

    def fit(self, candidates: Sequence[Candidate], total: int) -> None:
        """Fit ``candidates``, of about ``total`` models in the whole search."""
        self.waiting = list(candidates)
        for candidate in candidates:
            number = len(self.fits) + len(self.failed) + 1
            label = f"{number} of about {total}, {candidate.model}"
            began, known = time.perf_counter(), self._known(candidate.model)
            try:
                fit = (
                    known.fit
                    if known
                    else self._fit_to(
                        candidate, self.records, self.train, self.validate, label
                    )
                )
                rmse = fit.report.train.rmse + fit.report.validation.rmse
                if not np.isfinite(rmse):
                    raise ValueError("its free run is not finite")
            # The failure of one model must not end the comparison.
            except Exception as error:
                kind = "" if isinstance(error, ValueError) else type(error).__name__
                note = ": ".join(text for text in (kind, str(error)) if text)
                self.failed.append(
                    RankedModel(
                        model=candidate.model,
                        status="failed",
                        note=" ".join(note.split()),
                        wall_s=time.perf_counter() - began,
                    )
                )
            else:
                self.fits[candidate.model] = fit
            self.waiting.remove(candidate)
            if candidate.model not in self.fits:
                continue
            # Keep the fit first: its evaluation on other records takes as long.
            if known is None:
                self._keep(candidate.model)
            self.fitted()
            if not self.left_out:
                continue
            if known is not None and known.has_across:
                self.across[candidate.model] = known.across
            else:
                self.across[candidate.model] = errors_across(
                    self.left_out,
                    lambda others, part, candidate=candidate, label=label: self._fit_to(
                        candidate, others, part, part, label
                    ),
                )
                self._keep(candidate.model)
            self.fitted()

    def _known(self, model: str) -> Finished | None:
        if self.unfinished is None:
            return None
        return self.unfinished.found(model, self.records, self.train, self.validate)

    def _keep(self, model: str) -> None:
        if self.unfinished is not None:
            across, has_across = self.across.get(model), model in self.across
            self.unfinished.keep(model, self.fits[model], across, has_across)

    def _fit_to(
        self,
        candidate: Candidate,
        records: Sequence[Record],
        train: slice,
        validate: slice,
        label: str,
    ) -> Fit:
        return identify(
            records,
            candidate.model,
            method=candidate.method,
            train=train,
            validate=validate,
            options=self._options,
            progress=_LabelledProgress(self._progress, label),
        )

    def samples(self) -> np.ndarray:
        """Return the effective number of training samples [p] for the best fit."""
        best = min(self.fits.values(), key=lambda fit: fit.report.train.rmse)
        return effective_samples(best.errors(self.train))

    def criteria(self) -> dict[str, Criteria]:
        """Return AIC and BIC by model."""
        samples = self.samples()
        return {
            model: criteria(
                np.mean(np.concatenate(fit.errors(self.train)) ** 2, axis=0),
                samples,
                fit.count,
            )
            for model, fit in self.fits.items()
        }

    def duplicates(self) -> dict[str, str]:
        """Return the earlier equivalent of each model that has one.

        "Earlier" refers to the list of hysteresis parts, not to the order of the fits.
        """
        if not self.fits:
            return {}
        models = self._listed()
        scores = self.criteria()
        alike = first_equivalent(
            [scores[model].bic for model in models],
            [self.fits[model].count for model in models],
            [self.fits[model].errors(slice(None)) for model in models],
        )
        return {
            models[i]: models[j] for i, j in enumerate(alike) if models[i] != models[j]
        }

    def ranked(self) -> dict[str, bool]:
        """Return whether each model validates as well as the best, best model first."""
        if not self.fits:
            return {}
        models, scores, duplicates = self._listed(), self.criteria(), self.duplicates()
        # Equivalent models share their lowest BIC: the first listed ranks first.
        bics = [
            min(
                scores[m].bic
                for m in models
                if duplicates.get(m, m) == duplicates.get(own, own)
            )
            for own in models
        ]
        order, well = ranking(bics, [self._judged(model) for model in models])
        return {models[i]: well[i] for i in order}

    def _judged(self, model: str) -> Sequence[np.ndarray] | None:
        """Return the errors that the choice compares, None if the model failed."""
        if self.is_across():
            return self.across.get(model)
        return self.fits[model].errors(self.validate)

    def is_across(self) -> bool:
        """Return whether any model has errors on records left out of its fits.

        Until then the models are compared on the validation part.
        """
        return any(self.across.values())

    def note(self, model: str, duplicates: Mapping[str, str]) -> str:
        """Return a note if ``model`` fails on other records or has an equivalent."""
        if self.across.get(model, ()) is None:
            return "no model of a record that its fit left out: it fails there"
        if model in duplicates:
            return f"equivalent to {duplicates[model]}"
        return ""

    def across_rmse(self, model: str) -> float | None:
        """Return the rms error of ``model`` on the records left out of its fits."""
        errors = self.across.get(model)
        if errors is None:
            return None
        return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))

    def _listed(self) -> list[str]:
        names = parts_at("hysteresis")
        places = {name: place for place, name in enumerate(names)}
        return sorted(
            self.fits, key=lambda model: places.get(model.split("+")[0], len(names))
        )
