"""Comparison of all models that the records support."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ..core.progress import Progress, Silent
from .candidates import (
    Candidate,
    UntriedModel,
    first_round,
    later_rounds,
    parts_at,
    single_channel,
)
from .estimators.estimate import Options
from .model_search import Search
from .ranking import (
    RULE,
    RULE_ACROSS,
    ModelRanking,
    RankedModel,
    RankingReport,
    file_name,
)
from .records.parts import check_compatible, train_validation_and_test
from .records.record import Record
from .unfinished import Unfinished

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
    folder: Path | None = None,
) -> ModelRanking:
    """Fit every model that ``records`` support, and choose one by RULE.

    For several records of one input and one output the rule is RULE_ACROSS: each record
    in turn is left out of a fit and predicted by it.

    The first round fits each hysteresis (only the named ones, if any are named) with
    the richest creep and dynamics that the records support, a linear model, and the
    models that are not chains of parts. Further rounds fit the best few with other
    creeps or none, and with simpler dynamics. Failed and unsupported models are rows of
    the report. ``train`` and ``validate`` are as in ``identify``; by default they are
    the halves of the samples before ``test``. ``done`` receives the ranking so far,
    marked as interrupted, after each fit. Ctrl-C ends the search and keeps the models
    fitted so far. In ``folder``, if given, the fits are stored until the search has
    ended; another call with the same arguments continues from them.

    Raises ValueError as ``identify`` does for records and parts, for a ``test`` that
    shares samples with the other parts, for a ``folder`` with fits of another search,
    and if no model can be fitted.
    """
    began = time.perf_counter()
    records = (records,) if isinstance(records, Record) else tuple(records)
    check_compatible(records)
    samples = min(record.samples for record in records)
    train, validate, test = train_validation_and_test(samples, train, validate, test)
    options = options or Options()
    first, untried = first_round(records, train, options, hysteresis)
    search = Search(records, train, validate, options, progress or Silent())
    if folder is not None:
        search.unfinished = Unfinished(
            folder, records, (train, validate, test), options
        )
    if len(records) > 1 and single_channel(records):
        # The choice must not use the test part.
        search.left_out = tuple(
            record if test is None else record.until(test.start) for record in records
        )

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
    if search.unfinished is not None:
        search.unfinished.remove()
    return _ranking_of(search, untried, test, False, time.perf_counter() - began)


def _chains(candidates: Sequence[Candidate]) -> list[str]:
    """Return the names of the candidates that are chains with a hysteresis."""
    names = parts_at("hysteresis")
    return [c.model for c in candidates if c.model.split("+")[0] in names]


def _ranking_of(
    search: Search,
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
            note=search.note(model, duplicates),
            parameters=fit.count,
            train_rmse=fit.report.train.rmse,
            validation_rmse=fit.report.validation.rmse,
            validation_rmse_percent_of_span=fit.report.validation.rmse_percent_of_span,
            across_rmse=search.across_rmse(model),
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
        rule=RULE_ACROSS if search.is_across() else RULE,
        unit=fits[best].report.validation.unit,
        train=(search.train.start, search.train.stop),
        validation=(search.validate.start, search.validate.stop),
        test_part=None if test is None else (test.start, test.stop),
        test=None if test is None else fits[best].error_over(test),
        samples=sum(len(part) for part in fits[best].errors(search.train)),
        effective_samples=[float(n) for n in search.samples()],
        interrupted=interrupted,
        across=search.is_across(),
        rows=[*rows, *search.failed, *left],
        wall_s=wall_s,
    )
    return ModelRanking(fits, report)
