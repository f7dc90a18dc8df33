"""Comparison of all models that the records support."""

import time
from collections.abc import Callable, Sequence

import numpy as np

from ..core.progress import Progress, Silent
from .candidates import Candidate, UntriedModel, first_round, later_rounds, parts_at
from .criteria import Criteria, criteria, effective_samples, first_equivalent, ranking
from .estimators.estimate import Options
from .fit import Fit, identify
from .ranking import RULE, ModelRanking, RankedModel, RankingReport, file_name
from .records.parts import check_compatible, train_and_validation
from .records.record import Record

CHAINS_KEPT = 2
"""Number of chains with a hysteresis that enter each further round."""


def identify_all(
    records: Record | Sequence[Record],
    *,
    hysteresis: Sequence[str] | None = None,
    train: slice | None = None,
    validate: slice | None = None,
    test: slice | None = None,
    options: Options | None = None,
    progress: Progress | None = None,
    done: Callable[[ModelRanking], None] | None = None,
) -> ModelRanking:
    """Fit every model that ``records`` support, and choose one by RULE.

    The first round fits each hysteresis (only the named ones, if any are named) with
    the richest creep and dynamics that the records support, a linear model, and the
    models that are not chains of parts. Further rounds fit the best few with other
    creeps or none, and with simpler dynamics. Failed and unsupported models are rows of
    the report. ``train`` and ``validate`` are as in ``identify``; by default they are
    the halves of the samples before ``test``. ``done`` receives the ranking so far,
    marked as interrupted, after each fit. Ctrl-C ends the search and keeps the models
    fitted so far.

    Raises ValueError as ``identify`` does for records and parts, for a ``test`` that
    shares samples with the other parts, and if no model can be fitted.
    """
    began = time.perf_counter()
    records = (records,) if isinstance(records, Record) else tuple(records)
    check_compatible(records)
    samples = min(record.samples for record in records)
    train, validate, test = _split(samples, train, validate, test)
    options = options or Options()
    first, untried = first_round(records, train, options, hysteresis)
    search = _Search(records, train, validate, options, progress or Silent())

    def so_far() -> ModelRanking:
        left = [UntriedModel(c.model, "interrupted before") for c in search.waiting]
        return _ranking_of(
            search, [*untried, *left], test, True, time.perf_counter() - began
        )

    if done is not None:
        search.fitted = lambda: done(so_far())
    rounds = later_rounds(records, train)
    total = len(first) + sum(
        len(later(_chains(first)[:CHAINS_KEPT])) for later in rounds
    )
    try:
        search.fit(first, total)
        for later in rounds:
            duplicates = search.duplicates()
            chains = _chains(
                [
                    Candidate(model)
                    for model in search.ranked()
                    if model not in duplicates
                ]
            )
            search.fit(
                [c for c in later(chains[:CHAINS_KEPT]) if c.model not in search.fits],
                total,
            )
    except KeyboardInterrupt:
        if not search.fits:
            raise
        return so_far()
    if not search.fits:
        why = "; ".join(f"{row.model}: {row.note}" for row in search.failed) or (
            "; ".join(f"{one.model}: {one.reason}" for one in untried)
        )
        raise ValueError(f"no model could be fitted ({why})")
    return _ranking_of(search, untried, test, False, time.perf_counter() - began)


def _chains(candidates: Sequence[Candidate]) -> list[str]:
    """Return the names of the candidates that are chains with a hysteresis."""
    names = parts_at("hysteresis")
    return [c.model for c in candidates if c.model.split("+")[0] in names]


def _split(
    samples: int, train: slice | None, validate: slice | None, test: slice | None
) -> tuple[slice, slice, slice | None]:
    if test is None:
        return *train_and_validation(samples, train, validate), None
    test = slice(test.start or 0, samples if test.stop is None else test.stop)
    if not 0 <= test.start < test.stop <= samples:
        raise ValueError(
            f"test is {test.start}:{test.stop}; "
            f"it must lie in 0:{samples} and hold a sample"
        )
    train = train or slice(0, test.start // 2)
    validate = validate or slice(train.stop, test.start)
    train, validate = train_and_validation(samples, train, validate)
    for name, part in (("train", train), ("validate", validate)):
        if part.start < test.stop and test.start < part.stop:
            raise ValueError(
                f"test {test.start}:{test.stop} shares samples with {name} "
                f"{part.start}:{part.stop}; they must not overlap"
            )
    return train, validate, test


class _LabelledProgress:
    """Progress whose stages are labelled with the number and name of the model."""

    def __init__(self, progress: Progress, label: str):
        self._progress, self._label = progress, label

    def stage(self, text: str, steps: int = 0) -> None:
        self._progress.stage(f"{self._label}: {text}", steps)

    def advance(self, best: float, note: str = "") -> None:
        self._progress.advance(best, note)


class _Search:
    """Search state: fits, failed models and waiting candidates.

    ``fitted`` is called after each fit.
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
        self.fitted: Callable[[], None] = lambda: None

    def fit(self, candidates: Sequence[Candidate], total: int) -> None:
        self.waiting = list(candidates)
        for candidate in candidates:
            number = len(self.fits) + len(self.failed) + 1
            label = f"{number} of about {total}, {candidate.model}"
            began = time.perf_counter()
            try:
                fit = identify(
                    self.records,
                    candidate.model,
                    method=candidate.method,
                    train=self.train,
                    validate=self.validate,
                    options=self._options,
                    progress=_LabelledProgress(self._progress, label),
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
            if candidate.model in self.fits:
                self.fitted()

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
        """Return each model that is equivalent to an earlier one, and that model.

        The order is that of the list of hysteresis parts, not that of the fits.
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
        errors = [self.fits[model].errors(self.validate) for model in models]
        order, well = ranking(bics, errors)
        return {models[i]: well[i] for i in order}

    def _listed(self) -> list[str]:
        names = parts_at("hysteresis")
        places = {name: place for place, name in enumerate(names)}
        return sorted(
            self.fits, key=lambda model: places.get(model.split("+")[0], len(names))
        )


def _ranking_of(
    search: _Search,
    untried: Sequence[UntriedModel],
    test: slice | None,
    interrupted: bool,
    wall_s: float,
) -> ModelRanking:
    ranked, scores = search.ranked(), search.criteria()
    fits = {model: search.fits[model] for model in ranked}
    best, duplicates = next(iter(ranked)), search.duplicates()
    rows = [
        RankedModel(
            model=model,
            status="fitted",
            note=f"equivalent to {duplicates[model]}" if model in duplicates else "",
            parameters=fit.count,
            train_rmse=fit.report.train.rmse,
            validation_rmse=fit.report.validation.rmse,
            validation_rmse_percent_of_span=fit.report.validation.rmse_percent_of_span,
            aic=scores[model].aic,
            bic=scores[model].bic,
            validates_as_well=ranked[model],
            wall_s=fit.report.wall_s,
            warnings=fit.report.warnings,
            folder="." if model == best else f"models/{file_name(model)}",
        )
        for model, fit in fits.items()
    ]
    left = [
        RankedModel(model=u.model, status="not tried", note=u.reason) for u in untried
    ]
    report = RankingReport(
        best=best,
        rule=RULE,
        unit=fits[best].report.validation.unit,
        train=(search.train.start, search.train.stop),
        validation=(search.validate.start, search.validate.stop),
        test_part=None if test is None else (test.start, test.stop),
        test=None if test is None else fits[best].error_over(test),
        samples=sum(len(part) for part in fits[best].errors(search.train)),
        effective_samples=[float(n) for n in search.samples()],
        interrupted=interrupted,
        rows=[*rows, *search.failed, *left],
        wall_s=wall_s,
    )
    return ModelRanking(fits, report)
