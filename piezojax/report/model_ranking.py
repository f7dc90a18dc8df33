"""Files, picture and table of ``identify --model all``."""

import csv
import io
import shutil
from contextlib import suppress
from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from ..core.files import write_report, write_text
from ..identification.fit import Fit
from ..identification.ranking import (
    ModelRanking,
    RankedModel,
    RankingReport,
    file_name,
)
from .figures import (
    AFTER,
    BEFORE,
    MEASURED,
    REFERENCE,
    Pictures,
    add_title,
    figure,
    plain_tick_labels,
    plot_style,
    write,
)
from .fit_pictures import FIT_FILE, display_unit, loop_panel, write_fit, write_model
from .page import Page

RANKING_FILE, TABLE_FILE = "comparison.json", "comparison.csv"
RANKING_PICTURE = "comparison.png"

_MODELS = "models"

SHOWN = 3
"""Number of models whose residuals are drawn, the best ones."""

SHADES = (AFTER, BEFORE, REFERENCE)


def write_ranking(ranking: ModelRanking, folder: Path) -> Pictures:
    """Write the ranking, the files of the best fit, and the other models.

    Each of the other models has a folder under models/, named in its row. Returns the
    pictures.
    """
    drawn = write_fit(ranking.best, folder)
    _write_table(ranking, ranking.report, folder)
    with plot_style():
        drawn |= write(ranking_figure(ranking), folder / RANKING_PICTURE)
    # write_ranking_so_far put the best model among the others.
    shutil.rmtree(folder / _place(ranking.report.best), ignore_errors=True)
    with suppress(OSError):  # the folder holds other models, or is missing
        (folder / _MODELS).rmdir()
    return drawn


def write_ranking_so_far(ranking: ModelRanking, folder: Path) -> None:
    """Write the ranking of an unfinished search, with all its models under models/.

    Models that are in ``folder`` already are not written again.
    """
    rows = [
        row if row.folder is None else row.model_copy(update={"folder": place})
        for row in ranking.report.rows
        for place in [_place(row.model)]
    ]
    report = ranking.report.model_copy(update={"rows": rows})
    _write_table(ranking, report, folder)


def _place(model: str) -> str:
    return f"{_MODELS}/{file_name(model)}"


def _write_table(ranking: ModelRanking, report: RankingReport, folder: Path) -> None:
    """Write the models in the folders that ``report`` names, then the table."""
    for row in report.rows:
        if row.folder not in (None, "."):
            place = folder / row.folder
            if not (place / FIT_FILE).exists():
                place.mkdir(parents=True, exist_ok=True)
                write_model(ranking.fits[row.model], place)
    write_report(folder / RANKING_FILE, report)
    write_text(folder / TABLE_FILE, _csv(report))


def _csv(report: RankingReport) -> str:
    text = io.StringIO()
    rows = [row.model_dump() for row in report.rows]
    for row in rows:
        row["warnings"] = " | ".join(row["warnings"])
    writer = csv.DictWriter(text, list(RankedModel.model_fields), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _folded(model: str) -> str:
    """Return ``model`` in two lines, to fit a narrow column."""
    return model.replace("+", "\n+", 1)


def ranking_table(report: RankingReport) -> Table:
    """Return the table of the fitted models, best first, and of the failed ones."""
    where = "each record left out" if report.across else "the validation part"
    table = Table(title=f"free-run rms error on {where}, {report.unit}")
    table.add_column("model", no_wrap=True)
    for title in ("error  ", "para-\nmeters", "BIC", "time,\ns", "notes"):
        table.add_column(title, justify="right", no_wrap=True)
    least = min(row.bic for row in report.rows if row.bic is not None)
    for row in report.rows:
        if row.status == "not tried":
            continue
        if row.bic is None:
            table.add_row(_folded(row.model), "failed", "-", "-", f"{row.wall_s:.1f}")
            continue
        error = report.error_of(row)
        table.add_row(
            _folded(row.model),
            "fails *"
            if error is None
            else f"{error:.3g} {' ' if row.validates_as_well else '*'}",
            str(row.parameters),
            f"+{row.bic - least:.0f}",
            f"{row.wall_s:.1f}",
            str(len(row.warnings)),
            style="bold" if row.model == report.best else None,
        )
    table.caption = (
        "BIC above the lowest; * validates significantly worse than the best"
    )
    return table


def ranking_page(ranking: ModelRanking) -> Page:
    """Return the Page of a comparison of models."""
    report, best = ranking.report, ranking.best
    return Page(
        f"models of {best.record.source}",
        best.report.alarms,
        [
            ranking_table(report),
            *ranking_notes(report),
            *(f"note: {text}" for text in best.report.warnings),
            f"fitted in {report.wall_s:.1f} s",
        ],
        best.about.origin("Model of a plant"),
    )


def ranking_notes(report: RankingReport) -> list[str]:
    """Return the notes on the table, one line each."""
    notes = [f"{row.model} failed: {row.note}" for row in _rows(report, "failed")]
    for reason, rows in groupby(_rows(report, "not tried"), key=lambda row: row.note):
        notes.append(f"not tried: {', '.join(row.model for row in rows)}: {reason}")
    notes += [
        f"{row.model} is {row.note}" for row in _rows(report, "fitted") if row.note
    ]
    share = sum(report.effective_samples) / len(report.effective_samples)
    notes.append(
        f"{report.samples} training samples count as {share:.0f} in BIC: errors of a "
        "free run are correlated"
    )
    if report.interrupted:
        notes.append("interrupted: the best of the models fitted so far")
    notes.append(f"best: {report.best} ({report.rule})")
    if report.test is None:
        used = "the left-out records" if report.across else "the validation part"
        notes.append(
            f"the choice used {used}, so the error there is not a held-out error; "
            "--test START:STOP reserves samples for one"
        )
    else:
        notes.append(
            "its error on the test part, which neither the fits nor the choice used: "
            f"{report.test.rmse:.4g} {report.test.unit}, "
            f"{report.test.rmse_percent_of_span:.2f} % of span"
        )
    return notes


def _rows(report: RankingReport, status: str) -> list[RankedModel]:
    return [row for row in report.rows if row.status == status]


def ranking_figure(ranking: ModelRanking) -> Figure:
    """Draw all errors, the loop of the best model, and residuals of the best few."""
    report = ranking.report
    picture = figure(10.0, max(4.5, 0.9 + 0.36 * len(ranking.fits)))
    grid = picture.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    _errors_panel(picture.add_subplot(grid[:, 0]), report)
    best = list(ranking.fits.values())[:SHOWN]
    record = best[0].record
    if record.single:
        loop_panel(picture.add_subplot(grid[0, 1]), best[0], "chosen")
    rows = 1 if record.single else slice(None)
    _residual_panel(picture.add_subplot(grid[rows, 1]), best)
    add_title(picture, f"Models fitted to {record.source}")
    return picture


def _errors_panel(ax: Axes, report: RankingReport) -> None:
    rows = [row for row in report.rows if report.error_of(row) is not None]
    rows.sort(key=lambda row: report.error_of(row) or 0.0, reverse=True)
    errors = np.array([report.error_of(row) for row in rows], dtype=float)
    for place, row in enumerate(rows):
        chosen = row.model == report.best
        colour = AFTER if chosen else MEASURED
        ax.plot(errors[place], place, "o", color=colour, ms=7 if chosen else 5)
        ax.annotate(
            f"{row.parameters}",
            (errors[place], place),
            xytext=(7, 0),
            textcoords="offset points",
            va="center",
            color=colour,
            fontweight="bold" if chosen else "normal",
        )
    judged = "error on each record left out" if report.across else "validation error"
    ax.set_yticks(range(len(rows)), [_folded(row.model) for row in rows], fontsize=7)
    ax.set_ylim(-0.7, len(rows) - 0.3)
    ax.margins(x=0.12)
    if errors.max() > 5.0 * errors.min():
        ax.set_xscale("log")
        plain_tick_labels(ax.xaxis)
    ax.set(
        xlabel=f"{judged} ({display_unit(report.unit)} rms)",
        title="Error and number of parameters; chosen in blue",
    )


def _residual_panel(ax: Axes, fits: list[Fit]) -> None:
    part = fits[0].validate
    time = fits[0].record.time[part]
    for fit, colour in reversed(list(zip(fits, SHADES, strict=False))):
        label = f"{fit.report.model}: {fit.report.validation.rmse:.3g}"
        ax.plot(time, fit.errors(part)[0][:, 0], color=colour, lw=0.7, label=label)
    ax.set(
        xlabel="time (s)",
        ylabel=f"residual ({display_unit(fits[0].record.output_unit)})",
        title="Residuals of the best, validation part",
    )
    ax.legend(fontsize=6, loc="upper left", bbox_to_anchor=(0.0, -0.25))
