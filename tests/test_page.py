"""report.html: all that a command printed, and its pictures, in one file."""

import json
from html.parser import HTMLParser

import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner
from rich.table import Table
from rich.text import Text

from piezojax.cli import identify, sweep, tune, validate
from piezojax.report.page import PAGE, Page, page_html, table_html
from piezojax.tuning.result import load_result

LARGEST = 3_000_000
VOID = {"meta", "img", "br"}
STUDY = {
    "title": "a PID on a lag <quick>",
    "rate": 20_000.0,
    "seed": 3,
    "plant": {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.012},
    # so low that the result has an alarm
    "constraints": {"bandwidth": 9e3},
    "controller": {"catalog": "p753_pid"},
    "references": {"tune": ["SIN50", "SW50"], "duration": 0.05, "settle": 0.02},
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 5.0, "scale": "log"},
        "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"},
    },
    "optimiser": {"starts": 1, "candidates": 2, "steps": 2},
}


class Reader(HTMLParser):
    """Reader of a page: its tags must nest, and its links are collected."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.images = [], [], []
        self.cells, self.headings, self.alarms, self.captions = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.links += [found[key] for key in ("src", "href") if key in found]
        if tag == "img":
            self.images.append(found)
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        where = self.open[-1] if self.open else ""
        if where in ("td", "th"):
            self.cells[-1] += data
        if where in ("h1", "h2", "summary"):
            self.headings.append(data)
        if where == "caption":
            self.captions.append(data)
        if data.startswith("ALARM:"):
            self.alarms.append(data)


def checked(path):
    """Check that a page needs nothing outside itself; return what it holds."""
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) < LARGEST
    assert "<script" not in text
    found = Reader(text)
    assert all(link.startswith("data:image/png;base64,") for link in found.links)
    assert all(image["alt"] for image in found.images)
    assert len(found.images) == len(list(path.parent.glob("*.png")))
    return found


def call(command, *arguments):
    return CliRunner().invoke(command, [str(each) for each in arguments])


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
    text = page_html(page, tmp_path)
    assert '<h1>gains &lt;of&gt; a stage</h1>\n<p class="alarm">ALARM: it' in text
    found = Reader(text)
    assert found.alarms == ["ALARM: it rings & rails"]
    assert found.headings[-4:] == ["Notes", "Files", "study.toml", "Origin"]
    assert "<pre>title = &quot;a &lt; b&quot;</pre>" in text
    # Sections without content are left out.
    assert "Pictures" not in found.headings


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    path = folder / "study.toml"
    path.write_text(tomli_w.dumps(STUDY), encoding="utf-8")
    printed = call(tune.main, path, "--out", folder / "out")
    assert printed.exit_code == 3, printed.output
    return printed.output, folder / "out"


def test_the_page_of_tuning_holds_the_figures_of_its_result(tuned):
    printed, out = tuned
    assert f"page: {out / PAGE}; results in {out}" in printed
    found, result = checked(out / PAGE), load_result(out)
    assert found.alarms == [f"ALARM: {alarm}" for alarm in result.alarms] != []
    for path, value in result.gains.items():
        row = found.cells.index(path.removeprefix("controller."))
        before, after, unit = found.cells[row + 1 : row + 4]
        assert float(before) == pytest.approx(result.start[path], rel=1e-3)
        assert float(after) == pytest.approx(value, rel=1e-3)
        assert unit == result.gain_units[path]
    for name, rms in result.holdout.per_reference_rms_um.items():
        row = found.cells.index(name)
        assert float(found.cells[row + 2]) == pytest.approx(1e3 * rms, abs=0.006)
    report = json.loads((out / "stability.json").read_text(encoding="utf-8"))["after"]
    worst = max(branch["sensitivity_peak"] for branch in report.values())
    row = found.cells.index("tuned", found.cells.index("Ms"))
    assert float(found.cells[row + 1]) == pytest.approx(worst, abs=0.006)


def test_all_that_is_printed_is_on_the_page(tuned):
    printed, out = tuned
    text = (out / PAGE).read_text(encoding="utf-8")
    for line in printed.splitlines():
        if line.startswith(("note: ", "limit of linear control")):
            assert line.split("'")[0].split(">")[0] in text
    assert "SHA-256 of study.toml" in text
    assert "jaxlib" in text


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    path = tmp_path_factory.mktemp("record") / "record.csv"
    steps = np.arange(300)
    drive = np.where(steps < 150, 20.0, 10.0) * (1.0 - np.cos(2 * np.pi * steps / 25))
    moved = np.convolve(drive, 0.5 ** np.arange(1, 12))[:300]
    moved += 0.01 * np.random.default_rng(0).standard_normal(300)
    np.savetxt(
        path,
        np.c_[1e-3 * steps, drive, moved],
        delimiter=",",
        header="time_s,drive_V,moved_um",
        comments="",
    )
    return path


COLUMNS = ("--time", "time_s", "--input", "drive_V", "--output", "moved_um")


def test_models_have_pages(record, tmp_path):
    model = tmp_path / "model"
    printed = call(
        identify.main, record, *COLUMNS, "--model", "lag", "--out", model
    ).output
    assert f"page: {model / PAGE}" in printed
    found = checked(model / PAGE)
    fit = json.loads((model / "fit.json").read_text(encoding="utf-8"))
    assert f"validation {fit['validation']['rmse']:.3g} um" in " ".join(found.captions)
    value = fit["parameters"]["lag.time_constant"]["value"]
    row = found.cells.index("lag.time_constant")
    assert float(found.cells[row + 1]) == pytest.approx(value, rel=1e-4)
    assert found.cells[row + 3] == "s"
    other = tmp_path / "other"
    printed = call(
        validate.main, model / "model.json", record, *COLUMNS, "--out", other
    ).output
    assert f"page: {other / PAGE}" in printed
    assert "record.csv" in checked(other / PAGE).cells


def test_a_sweep_has_a_page(tmp_path):
    path = tmp_path / "study.toml"
    gain = {"lower": 200.0, "upper": 400.0, "count": 2}
    swept = {"parameters": {"controller.integral": gain}, "metrics": ["rms_error"]}
    study = {key: STUDY[key] for key in STUDY if key != "constraints"}
    path.write_text(tomli_w.dumps(study | {"sweep": swept}), encoding="utf-8")
    printed = call(sweep.main, path, "--out", tmp_path / "out")
    assert printed.exit_code == 0, printed.output
    assert f"page: {tmp_path / 'out' / PAGE}" in printed.output
    assert checked(tmp_path / "out" / PAGE).headings[0] == STUDY["title"]
