"""report.html: the tables of the terminal as HTML, alarms first, texts quoted."""

import re
from pathlib import Path

import pytest
from page_reader import Reader
from rich.table import Table
from rich.text import Text

import piezojax
from piezojax.report.figures import figure, plain_tick_labels
from piezojax.report.live_figures import LiveFigures
from piezojax.report.page import PICTURES, Page, page_html, table_html
from piezojax.report.reproduction_tables import reproduction_table
from piezojax.reproduction.cell import Cell
from piezojax.reproduction.rates import FIGURE
from piezojax.reproduction.summary import summarise


def test_a_table_is_that_of_the_terminal():
    table = Table(title="errors <nm>", caption="of all runs")
    table.add_column("name")
    table.add_column("rms\nnm", justify="right")
    table.add_row("a & b", Text("1.5", style="bold"), end_section=True)
    table.add_row("c", "2.5")
    text = table_html(table)
    assert "<caption>errors &lt;nm&gt;</caption>" in text
    assert '<th class="right">rms<br>nm</th>' in text
    assert '<tr class="end"><td class="left">a &amp; b</td>' in text
    assert '<td class="right">1.5</td></tr>' in text
    assert text.endswith("<p>of all runs</p>\n")
    assert Reader(text).cells == ["name", "rmsnm", "a & b", "1.5", "c", "2.5"]


def test_alarms_come_first_and_texts_are_quoted(tmp_path):
    (tmp_path / "study.toml").write_text('title = "a < b"', encoding="utf-8")
    page = Page("gains <of> a stage", ["it rings & rails"], ["a note"], ["seed 3"])
    text = page_html(page, tmp_path, LiveFigures())
    assert '<h1>gains &lt;of&gt; a stage</h1>\n<p class="alarm">ALARM: it' in text
    found = Reader(text)
    assert found.alarms == ["ALARM: it rings & rails"]
    assert found.headings[-4:] == ["Notes", "Files", "study.toml", "Origin"]
    assert "<pre>title = &quot;a &lt; b&quot;</pre>" in text
    # Sections without content are left out.
    assert "Pictures" not in found.headings


def test_a_table_in_parts_shows_all_its_numbers():
    cells = [Cell("7-4", "Z", f"c{i}", "um", 1.0 + i, 2.0 + i) for i in range(4)]
    found = Reader(
        table_html(reproduction_table("7-4", cells, summarise(cells)["7-4"]))
    )
    assert found.captions[0] == "Table 7-4: paper / simulation in um"
    for cell in cells:
        assert f"{cell.paper:.4f} / {cell.sim:.4f}" in found.cells


def test_every_picture_has_a_caption():
    sources = Path(piezojax.__file__).parent.rglob("*.py")
    text = "".join(path.read_text(encoding="utf-8") for path in sources)
    names = {*re.findall(r'(?<!f)"([\w-]+\.png)"', text), f"{FIGURE}.png"}
    assert {"tracking.png", "cells.png"} < names
    assert names == set(PICTURES)
    # A metric and a number stand in the other names; the caption is that name.
    computed = {"{FIGURE}.png", "{name}.png", "singular_values_{number}.png"}
    assert {*re.findall(r'f"([^"]+\.png)"', text)} == computed


@pytest.mark.parametrize(
    ("ends", "labels"),
    [
        ((0.6, 1.9), ["0.6", "0.7", "0.8", "0.9", "1", "2"]),
        ((0.05, 2.0), ["0.05", "0.1", "0.2", "0.5", "1", "2"]),
    ],
)
def test_a_short_logarithmic_axis_has_several_labels(ends, labels):
    picture = figure(4.0, 3.0)
    ax = picture.subplots()
    ax.plot(ends)
    ax.set_yscale("log")
    plain_tick_labels(ax.yaxis)
    picture.canvas.draw()
    low, high = ax.get_ylim()
    ticks = zip(ax.get_yticks(), ax.get_yticklabels(), strict=True)
    assert [text.get_text() for at, text in ticks if low <= at <= high] == labels
