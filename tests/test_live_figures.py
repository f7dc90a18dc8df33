"""Interactive figures: the curves, colours, labels and ranges of their pictures."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from page_reader import LARGEST, Reader

from piezojax.report import live_figures as module
from piezojax.report.figures import AFTER, BEFORE
from piezojax.report.live_figures import live_figures
from piezojax.report.live_panel import curves, live_panel
from piezojax.report.page import Page, page_html, write_page
from piezojax.report.thinned_curves import GAP, kept_samples

TIME = np.linspace(0.0, 1.0, 50)
LABELS = ("time (s)", "error (nm)")


def panel_of(columns=1000, **axis):
    """Return panels of matplotlib and Bokeh with two curves, a level and a shade."""
    ax = Figure().subplots()
    ax.plot(TIME, 1.0 + TIME**2, color=BEFORE, label="before")
    ax.plot(TIME, 3.0 - TIME, color=AFTER, ls="--", lw=0.7)
    ax.axhline(1.5, color="k")
    ax.axvspan(0.2, 0.4, color="#eef4f6")
    ax.set(xlim=(0.0, 1.0), ylim=(1.0, 3.0), **axis)
    return ax, live_panel(ax, LABELS, 300.0, curves(ax, columns))


def test_a_panel_has_the_curves_of_its_picture():
    ax, panel = panel_of(title="a title\n")
    before, after, level = panel.renderers
    for line, drawn in zip(ax.lines, (before, after), strict=False):
        data = drawn.data_source.data
        np.testing.assert_allclose(data["x"], line.get_xdata(), rtol=1e-6)
        np.testing.assert_allclose(data["y"], line.get_ydata(), rtol=1e-6)
    assert (before.name, after.name) == ("before", "")
    assert (before.glyph.line_color, after.glyph.line_color) == (BEFORE, AFTER)
    assert before.glyph.line_dash == []
    assert after.glyph.line_dash
    assert after.glyph.line_width == 0.7
    # A level crosses the whole panel.
    assert level.data_source.data["x"].tolist() == [0.0, 1.0]
    assert level.data_source.data["y"].tolist() == [1.5, 1.5]
    (shade,) = (each for each in panel.center if hasattr(each, "fill_color"))
    assert (shade.left, shade.right) == pytest.approx((0.2, 0.4))
    assert shade.fill_color == "#eef4f6"
    assert panel.title.text == "a title"
    assert (panel.xaxis.axis_label, panel.yaxis.axis_label) == LABELS
    assert (panel.y_range.start, panel.y_range.end) == (1.0, 3.0)


def test_a_panel_has_the_scales_of_its_picture():
    _, panel = panel_of(yscale="log")
    assert type(panel.y_scale).__name__ == "LogScale"
    assert type(panel.x_scale).__name__ == "LinearScale"


def test_values_are_read_with_their_units():
    # Where a curve has a name, lines without one are aids to the eye.
    _, panel = panel_of()
    (hover,) = (tool for tool in panel.tools if hasattr(tool, "tooltips"))
    assert hover.tooltips == [("before", "@y{%.5g} nm at @x{%.5g} s")]
    assert hover.renderers == [panel.renderers[0]]
    assert hover.mode == "vline"


@pytest.mark.parametrize(
    "draw",
    [
        lambda ax: ax.imshow(np.eye(2)),
        lambda ax: ax.fill_between(TIME, TIME, 1.0),
        lambda ax: ax.bar([1, 2], [3, 4]),
        lambda ax: ax.annotate("here", (0.5, 0.5)),
        lambda ax: ax.step(TIME, TIME),
        lambda ax: ax.set_xticks([0, 1], ["a", "b"]),
        lambda ax: ax.set_yscale("symlog"),
    ],
)
def test_other_pictures_stay_as_they_are(draw):
    picture = Figure()
    ax = picture.subplots()
    ax.plot(TIME, TIME)
    assert "plain.png" in live_figures({"plain.png": picture}).figures
    draw(ax)
    assert live_figures({"plain.png": picture}) == module.LiveFigures()


def test_panels_that_share_an_axis_move_together():
    picture = Figure()
    (left, right), (below, _) = picture.subplots(2, 2, sharex="col")
    right.sharey(left)
    below.set(xlabel="time (s)")
    left.set(ylabel="y (V)")
    samples, _ = module._thinned(picture.axes)
    grid = module._grid(picture, samples)
    panels = {(row, column): panel for panel, row, column in grid.children}
    assert panels[0, 0].x_range is panels[1, 0].x_range
    assert panels[0, 0].x_range is not panels[0, 1].x_range
    assert panels[0, 0].y_range is panels[0, 1].y_range
    assert panels[0, 0].xaxis.axis_label == "time (s)"
    assert panels[0, 1].yaxis.axis_label == "y (V)"


def test_a_page_without_curves_has_no_script(tmp_path):
    assert "<script" not in write_page(Page("a", (), []), tmp_path).read_text()


def test_texts_in_figures_are_quoted(tmp_path):
    name = "</script><b>'\"&\\"
    _, panel = panel_of(title=name)
    picture = Figure()
    picture.subplots().plot(TIME, TIME, label=name)
    live = live_figures({"a.png": picture})
    page = page_html(Page("a", (), []), tmp_path, live)
    assert name not in page
    Reader(page)  # all tags are closed
    assert panel.title.text == name


# Thinning


def test_a_thinned_curve_keeps_the_extremes_of_each_column():
    random, columns = np.random.default_rng(0), 40
    x = np.sort(random.uniform(0.0, 1.0, 5000))
    y = random.standard_normal(5000)
    kept = kept_samples(x, y, columns)
    assert kept.size <= 4 * columns
    assert np.all(np.diff(kept) > 0)
    for left in np.arange(columns) / columns:
        [inside] = np.nonzero((x >= left) & (x < left + 1.0 / columns))
        shown = np.intersect1d(inside, kept)
        assert (shown[0], shown[-1]) == (inside[0], inside[-1])
        assert y[shown].min() == y[inside].min()
        assert y[shown].max() == y[inside].max()


def test_missing_samples_of_a_thinned_curve_stay_missing():
    x, y = np.linspace(0.0, 0.999, 1000), np.arange(1000.0)
    y[300:450] = np.nan
    kept = kept_samples(x, y, 10)
    assert np.isnan(y[kept]).any()
    assert {299, 300, 449, 450} <= set(kept)


def test_samples_beside_the_range_are_left_out():
    x = np.linspace(-10.005, 9.995, 2001)
    kept = kept_samples(x, np.zeros(2001), 500)
    assert x[kept].min() == pytest.approx(-0.005)
    assert x[kept].max() == pytest.approx(1.005)
    assert kept_samples(x, np.zeros(2001), 5).size < 30


def test_a_loop_is_drawn_once():
    angle = np.linspace(0.0, 40.0 * np.pi, 20_001)
    x, y = 0.5 + 0.4 * np.cos(angle), 0.5 + 0.4 * np.sin(angle)
    kept = kept_samples(x, y, 100)
    assert kept.size <= 400
    assert GAP in kept or np.all(np.diff(kept) == 1)
    shown = kept[kept != GAP]
    # Every sample is near a drawn one, by the diagonal of a cell.
    away = np.hypot(np.subtract.outer(x, x[shown]), np.subtract.outer(y, y[shown]))
    assert away.min(axis=1).max() < 0.03
    few = kept_samples(x[:300], y[:300], 100)
    assert few.tolist() == [*range(300)]


def test_all_curves_of_a_page_keep_the_budget(tmp_path):
    samples = np.random.default_rng(1).standard_normal((30, 20_000))
    time = np.linspace(0.0, 1.0, 20_000)
    pictures = {}
    for number, three in enumerate(samples.reshape(10, 3, -1)):
        picture = Figure()
        picture.subplots().plot(time, three.T)
        pictures[f"{number}.png"] = picture
    live = live_figures(pictures)
    assert "each of 500 columns" in live.note
    assert len(live.scripts) < LARGEST - 500_000
