"""Page with the results of a command: ``report.html``, a self-contained file.

The page contains the tables and sentences that the command prints, and the pictures in
its folder. Pictures of curves are interactive in a browser that runs scripts.
"""

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image
from rich.table import Table
from rich.text import Text

from ..core.files import write_text
from ..core.profile import DRAWING, stage
from ..tuning.result import STUDY_FILE
from .figures import Pictures
from .live_figures import LiveFigures, live_figures

if TYPE_CHECKING:
    from bokeh.models import UIElement

PAGE = "report.html"
SLIDERS = "Other gains"

PICTURES = {
    "tracking.png": "References and tracking errors, before and after tuning",
    "steps.png": "Steps of the reference, before and after tuning",
    "stability.png": "Open loop, sensitivities and margins",
    "robustness.png": "Errors and constrained figures on the perturbed plants",
    "hysteresis.png": "Hysteresis of the stage, and error over reference",
    "coupling.png": "Errors of all axes with one driven, before and after tuning",
    "contour.png": "Contours and their errors, before and after tuning",
    "fit.png": "Record, model and residual",
    "response.png": "Measured frequency response and its model",
    "amplitudes.png": "Modes by amplitude of the input",
    "comparison.png": "Errors of the compared models or controllers",
    "validation.png": "The model on the other records",
    "excitation.png": "Voltages to record",
    "trial.png": "References, readings and errors on the stage",
    "retune.png": "Errors by attempt, and the first and the best run on the stage",
    "learn.png": "Errors by run, and the learned reference",
    "watch.png": "The stage in each run, beside the baseline",
    "limit.png": "Errors beside the limit of linear control",
    "structures.png": "Errors by the number of notches",
    "pareto.png": "Error against the constrained figure",
    "convergence.png": "Objective over the steps of the search",
    "baselines.png": "Best objective of each method over wall time",
    "cells.png": "Simulated against printed values",
    "figure-4-10.png": "Simulated errors by sampling rate",
    "calibration.png": "Simulated against printed values, fitted and held out",
}
"""Captions of the pictures by file, in the order of the page; others follow."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62em; margin: 2em auto;
       padding: 0 1em; color: #222; background: #fff; }
h1 { font-size: 1.5em; } h2 { font-size: 1.1em; margin: 1.8em 0 .4em; }
table { border-collapse: collapse; margin: 1.2em 0 .4em;
        font-variant-numeric: tabular-nums; }
th, td { padding: .15em .8em; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #222; } tr.end td { border-bottom: 1px solid #999; }
td.right, th.right { text-align: right; white-space: nowrap; }
.alarm { color: #b00020; font-weight: bold; }
.tables { overflow-x: auto; } caption { text-align: left; font-weight: bold; }
figure { margin: 1.5em 0; } img { max-width: 100%; }
figcaption { font-weight: bold; } pre { white-space: pre-wrap; }
.note { display: none; }
@media screen { .live:not(:empty) + img { display: none; }
  body:has(.live:not(:empty)) .note { display: block; } }
@media print { body { margin: 0; max-width: none; font-size: 11px; }
  .live { display: none; } .tables { overflow: visible; }
  figure, table { break-inside: avoid; } }
"""


@dataclass(frozen=True)
class Page:
    """Results of a command, to be printed and written to report.html.

    ``parts`` are tables and sentences in the order in which they are printed.
    ``origin`` are lines on how the results were made.
    """

    title: str
    alarms: Sequence[str]
    parts: Sequence[Table | str]
    origin: Sequence[str] = ()


@stage(DRAWING)
def write_page(
    page: Page,
    folder: Path,
    pictures: Pictures | None = None,
    sliders: "UIElement | None" = None,
) -> Path:
    """Write ``page`` and the pictures in ``folder`` to report.html in that folder.

    Those of the ``pictures`` that consist of curves are interactive. ``sliders`` are
    shown on a screen only.
    """
    path = folder / PAGE
    live = live_figures(pictures or {}, {SLIDERS: sliders} if sliders else None)
    write_text(path, page_html(page, folder, live))
    return path


def page_html(page: Page, folder: Path, live: LiveFigures) -> str:
    """Return ``page`` as HTML, with the pictures in ``folder`` and ``live`` figures."""
    title = escape(page.title)
    tables = [part for part in page.parts if isinstance(part, Table)]
    sentences = [part for part in page.parts if not isinstance(part, Table)]
    alarms = "".join(f'<p class="alarm">ALARM: {escape(a)}</p>\n' for a in page.alarms)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{title}</h1>\n{alarms}"
        + "".join(table_html(table) for table in tables)
        + _sliders(live)
        + _section("Notes", _list(sentences))
        + _section("Pictures", _note(live) + "".join(_figures(folder, live.figures)))
        + _section("Files", _quoted_study(folder))
        + _section("Origin", _list(page.origin))
        + f"{live.scripts}</body>\n</html>\n"
    )


def table_html(table: Table) -> str:
    """Return a printed table as HTML, with its title, header, rows and caption.

    A grid of tables becomes these tables, one below the other.
    """
    cells = [cell for column in table.columns for cell in column.cells]
    inner = [cell for cell in cells if isinstance(cell, Table)]
    if inner:
        return "".join(table_html(each) for each in inner)
    sides = ["right" if c.justify == "right" else "left" for c in table.columns]
    header = [_plain(column.header) for column in table.columns]
    cells = [[_plain(cell) for cell in column.cells] for column in table.columns]
    parts = [f"<caption>{_lines(table.title)}</caption>" if table.title else ""]
    if table.show_header:
        parts.append(f"<thead><tr>{_cells('th', header, sides)}</tr></thead>")
    rows = zip(table.rows, zip(*cells, strict=True), strict=True)
    parts.append("<tbody>")
    for row, texts in rows:
        end = ' class="end"' if row.end_section else ""
        parts.append(f"<tr{end}>{_cells('td', texts, sides)}</tr>")
    parts.append("</tbody>")
    below = f"<p>{_lines(table.caption)}</p>\n" if table.caption else ""
    body = "\n".join(part for part in parts if part)
    return f'<div class="tables"><table>\n{body}\n</table></div>\n{below}'


def _cells(tag: str, texts: Iterable[str], sides: Iterable[str]) -> str:
    return "".join(
        f'<{tag} class="{side}">{_lines(text)}</{tag}>'
        for text, side in zip(texts, sides, strict=True)
    )


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def _lines(text: object) -> str:
    return escape(_plain(text)).replace("\n", "<br>")


def _section(title: str, body: str) -> str:
    return f"<h2>{title}</h2>\n{body}" if body else ""


def _list(sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(each)}</li>\n" for each in sentences)
    return f"<ul>\n{items}</ul>\n" if items else ""


def _note(live: LiveFigures) -> str:
    return f'<p class="note">{live.note}</p>\n' if live.note else ""


def _sliders(live: LiveFigures) -> str:
    found = live.figures.get(SLIDERS)
    if not found:
        return ""
    title = f"<figcaption>{SLIDERS}</figcaption>"
    return f'<figure class="note">\n{title}\n{found}</figure>\n'


def _figures(folder: Path, live: Mapping[str, str]) -> Iterable[str]:
    known = {path.name: path for path in sorted(folder.glob("*.png"))}
    rank = {name: place for place, name in enumerate(PICTURES)}
    for name in sorted(known, key=lambda name: rank.get(name, len(rank))):
        caption = PICTURES.get(name, name.removesuffix(".png").replace("_", " "))
        data = base64.b64encode(_small(known[name])).decode("ascii")
        yield (
            f"<figure>\n<figcaption>{escape(caption)}</figcaption>\n"
            f'{live.get(name, "")}<img alt="{escape(caption)}" '
            f'src="data:image/png;base64,{data}">\n</figure>\n'
        )


def _small(path: Path) -> bytes:
    """Return a picture with at most 256 colours: a third of its bytes, or less."""
    small = io.BytesIO()
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(method=Image.Quantize.FASTOCTREE).save(
            small, "png", optimize=True
        )
    return small.getvalue()


def _quoted_study(folder: Path) -> str:
    path = folder / STUDY_FILE
    if not path.is_file():
        return ""
    text = escape(path.read_text(encoding="utf-8"))
    return f"<details open><summary>{path.name}</summary><pre>{text}</pre></details>\n"
