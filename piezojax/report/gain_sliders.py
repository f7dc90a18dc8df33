"""Sliders of the tuned gains, with the figures that a surrogate gives for them."""

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from ..analysis.step_response import BAND
from ..core.arrays import as_array
from ..core.profile import DRAWING, stage
from ..core.space import SCALES
from ..tuning.gain_surrogate import Figures, GainSurrogate
from ..tuning.near_gains import MARGINS, STEP
from ..tuning.outcome import Outcome
from .figures import AFTER, BEFORE
from .tuning_tables import short_names

# Bokeh is imported where it draws: its import takes as long as all others together.
if TYPE_CHECKING:
    from bokeh.models import ColumnDataSource, Slider, UIElement

MEAN = "geometric mean"

SENTENCE = (
    "Move a slider to see what other gains would give on the nominal plant, with the "
    "references and the noise of the hold-out. {simulated} gain sets were simulated, "
    "all of them stable; the figures are interpolated between most of them. The others "
    "test the interpolation: on 19 of 20 its error is at most that in the last column. "
    "Gains that you choose here are not tested on other plants: write them into the "
    "study as starts and tune again before you use them."
)

_SETTLING_TIMES = 5.0  # number of settling times of the tuned loop that are shown
_LEAST = 0.02  # smallest share of the run that is shown

_MOVED = files("piezojax.report") / "gain_sliders.js"
_VALUE = """
const scaled = low + tick * (high - low)
const unscaled = { log: Math.exp, logit: (z) => 1 / (1 + Math.exp(-z)) }[scale]
const value = unscaled ? unscaled(scaled) : scaled
const typed = step && Number((step * Math.round(value / step)).toPrecision(12))
return `${step ? typed : value.toPrecision(4)} ${unit}`
"""

_STYLE = """
:host { font: 15px/1.5 system-ui, sans-serif; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .15em .8em; text-align: left; }
th { border-bottom: 2px solid #222; }
td:nth-child(2), td:nth-child(3) { text-align: right; }
"""


@stage(DRAWING)
def gain_sliders(
    surrogate: GainSurrogate | str | None, outcome: Outcome
) -> "UIElement | None":
    """Return the sliders of the tuned gains, the step, and the table of figures.

    Return None if ``surrogate`` is None or the reason why there is none.
    """
    if not isinstance(surrogate, GainSurrogate):
        return None
    from bokeh.layouts import column, row
    from bokeh.models import ColumnDataSource, CustomJS, Div

    style: dict[str, Any] = {"sizing_mode": "stretch_width", "stylesheets": [_STYLE]}
    own = surrogate.tuned
    step = {"time": 1e3 * surrogate.times, "displacement": surrogate.at(own).step}
    shown = ColumnDataSource(step)
    texts = _texts(surrogate)
    table = Div(text=_joined(texts, surrogate.at(own)), **style)
    sliders = _sliders(surrogate, outcome)
    moved = CustomJS(
        args={
            "sliders": sliders,
            "centres": surrogate.at.centres.tolist(),
            "weights": surrogate.at.weights.ravel(),
            "outputs": surrogate.at.weights.shape[1],
            "components": list(surrogate.at.components),
            "basis": surrogate.at.basis.ravel(),
            "shown": shown,
            "table": table,
            "texts": texts,
        },
        code=_MOVED.read_text("utf-8"),
    )
    for slider in sliders:
        slider.js_on_change("value", moved)
    controls = column(*sliders, _back(sliders), sizing_mode="stretch_width")
    panel = _step_panel(ColumnDataSource(step), shown)
    sentence = SENTENCE.format(simulated=surrogate.simulated)
    return column(
        Div(text=f"<p>{sentence}</p>", **style),
        row(controls, panel, sizing_mode="stretch_width"),
        table,
        sizing_mode="stretch_width",
    )


def _step_panel(tuned: "ColumnDataSource", shown: "ColumnDataSource") -> "UIElement":
    from bokeh.models import Range1d
    from bokeh.plotting import figure

    panel = figure(
        x_range=Range1d(start=0.0, end=_shown_until(tuned)),
        title=STEP,
        height=320,
        sizing_mode="stretch_width",
        x_axis_label="time (ms)",
        y_axis_label="displacement (µm)",
        tools="box_zoom,pan,reset",
    )
    panel.axis.axis_label_text_font_style = "normal"
    lines = {"tuned gains": (tuned, BEFORE), "gains of the sliders": (shown, AFTER)}
    for name, (source, colour) in lines.items():
        panel.line(
            "time",
            "displacement",
            source=source,
            color=colour,
            line_width=2,
            legend_label=name,
            name=name,
        )
    panel.legend.location = "bottom_right"
    return panel


def _shown_until(tuned: "ColumnDataSource") -> float:
    """Return the time (ms) until which the step is shown, some settling times."""
    time, step = (np.asarray(tuned.data[name]) for name in ("time", "displacement"))
    away = np.abs(step - step[-1]) > BAND * np.ptp(step)
    until = _SETTLING_TIMES * max(time[away], default=0.0)
    return float(np.clip(until, _LEAST * time[-1], time[-1]))


def _sliders(surrogate: GainSurrogate, outcome: Outcome) -> "list[Slider]":
    """Return a slider for each gain: 0 to 1 in its range, labelled with its value."""
    from bokeh.models import CustomJSTickFormatter, Slider

    space, units = outcome.case.space, outcome.result.gain_units
    rows = zip(
        short_names(space.paths)[1],
        space.ranges().items(),
        surrogate.lower,
        surrogate.upper,
        surrogate.tuned,
        strict=True,
    )
    sliders = []
    for name, (path, bounds), lower, upper, tuned in rows:
        scaled = SCALES[bounds.scale][0]
        low, high = (float(scaled(as_array(x))) for x in (bounds.lower, bounds.upper))
        gain = {
            "scale": bounds.scale,
            "low": low + float(lower) * (high - low),
            "high": low + float(upper) * (high - low),
            "step": bounds.step,
            "unit": units.get(path, ""),
        }
        sliders.append(
            Slider(
                start=0.0,
                end=1.0,
                step=0.002,
                value=float(tuned),
                title=name,
                format=CustomJSTickFormatter(args=gain, code=_VALUE),
                sizing_mode="stretch_width",
            )
        )
    return sliders


def _back(sliders: "Sequence[Slider]") -> "UIElement":
    """Return the button that moves the ``sliders`` back to the tuned gains."""
    from bokeh.models import Button, CustomJS

    back = Button(label="back to the tuned gains", width=200)
    code = "sliders.forEach((slider, index) => { slider.value = places[index] })"
    places = [slider.value for slider in sliders]
    back.js_on_event(
        "button_click", CustomJS(args={"sliders": sliders, "places": places}, code=code)
    )
    return back


def _texts(surrogate: GainSurrogate) -> list[str]:
    """Return the HTML of the table, split where the figures of the sliders belong."""
    doubt = surrogate.doubt
    errors = [f"rms error under {name}" for name in surrogate.references]
    names = [*errors, MEAN, *surrogate.margins]
    units = [*["nm"] * (len(errors) + 1), *(MARGINS[m].unit for m in surrogate.margins)]
    shares = [*doubt.errors, doubt.mean, *doubt.margins]
    tuned = _values(surrogate.at(surrogate.tuned))
    header = ("figure", "tuned", "sliders", "unit", "error of the interpolation")
    before = "<table><tr>" + "".join(f"<th>{each}</th>" for each in header) + "</tr>"
    texts = []
    for name, value, unit, share in zip(names, tuned, units, shares, strict=True):
        texts.append(f"{before}<tr><td>{escape(name)}</td><td>{value}</td><td>")
        before = f"</td><td>{unit}</td><td>{100.0 * share:.2g} %</td></tr>"
    return [*texts, f"{before}</table>"]


def _joined(texts: Sequence[str], figures: Figures) -> str:
    values = [*_values(figures), ""]
    return "".join(a + b for a, b in zip(texts, values, strict=True))


def _values(figures: Figures) -> list[str]:
    """Return the figures in the order of the table; errors in nm."""
    errors = 1e3 * figures.errors
    mean = np.exp(np.mean(np.log(errors)))
    return [f"{value:#.4g}" for value in (*errors, mean, *figures.margins)]
