"""Table and picture of the step tests of a study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..tuning.step_tests import StepResult, StepRun
from .figures import (
    AFTER,
    BEFORE,
    REFERENCE,
    add_title,
    figure,
    legend_above,
    plain_number,
)

Loops = tuple[Mapping[str, Any], Mapping[str, Any]]
"""Values by step, before and after tuning."""

_COLUMNS = {
    "rise_time_s": ("rise\nms", 1e3),
    "settling_time_s": ("to 2 %\nms", 1e3),
    "settling_time_fine_s": ("to 0.1 %\nms", 1e3),
    "settling_time_noise_s": ("to noise\nms", 1e3),
    "overshoot": ("over-\nshoot %", 100.0),
    "steady_state_error": ("error\nleft %", 100.0),
}
"""Columns of the table: title with unit, and the factor from s or a share to the
unit."""

_ROOM = 2.0  # length of the picture, in settling times
_HEIGHTS = 3.0  # most overshoot that is drawn, in heights of the step
_MARGIN = 0.1  # room above and below, in heights of the step


def steps_table(steps: Loops) -> Table:
    """Return the figures of the steps (StepResult) of each loop.

    Each figure is the worse one of the step up and the same step down.
    """
    table = Table(title="steps without noise, the worse of up and down")
    table.add_column("step", no_wrap=True)
    for title, _ in _COLUMNS.values():
        table.add_column(title, justify="right", no_wrap=True)
    for size in ("small", "large"):
        for loop, found in zip(("before", "tuned"), steps, strict=True):
            both = [found[f"{size} step {way}"] for way in ("up", "down")]
            height = abs(both[0].after_um - both[0].before_um)
            cells = (_worse(both, name, by) for name, (_, by) in _COLUMNS.items())
            table.add_row(f"{height:.3g} um, {loop}", *cells)
    return table


def _worse(steps: Sequence[StepResult], name: str, factor: float) -> str:
    if any(step.overshoot is None for step in steps):
        return "diverges"
    values = [getattr(step, name) for step in steps]
    if any(value is None for value in values):
        return "never"
    return plain_number(factor * max(values))


def steps_figure(runs: Loops, steps: Loops, title: str) -> Figure:
    """Draw each step (StepRun) before and after tuning, and its settling bands."""
    picture = figure(9.0, 5.2)
    for ax, name in zip(picture.subplots(2, 2).ravel(), runs[0], strict=True):
        run: StepRun = runs[0][name]
        length, shown = run.time[-1], 20.0 * (run.time[1] - run.time[0])
        for both, found, colour, label in zip(
            runs, steps, (BEFORE, AFTER), ("before", "tuned"), strict=True
        ):
            settled = found[name].settling_time_s
            shown = max(shown, length if settled is None else _ROOM * settled)
            text = label if settled is None else f"{label}, {1e3 * settled:.3g} ms"
            ax.plot(1e3 * run.time, both[name].displacement, color=colour, label=text)
        before, after = run.ends
        for share in (-0.02, 0.02):
            level = after + share * (after - before)
            ax.axhline(level, color=REFERENCE, lw=0.7, ls=":")
        ax.axhline(after, color=REFERENCE, lw=0.9, ls="--")
        height = abs(after - before)
        drawn = np.r_[run.ends, runs[0][name].displacement, runs[1][name].displacement]
        bottom, top = np.nanmin(drawn), np.nanmax(drawn)
        most = _HEIGHTS * height
        ax.set(
            title=f"{name}\n",
            xlabel="time since the step (ms)",
            ylabel="displacement (µm)",
            xlim=(0.0, 1e3 * min(length, shown)),
            ylim=(
                max(bottom, min(run.ends) - most) - _MARGIN * height,
                min(top, max(run.ends) + most) + _MARGIN * height,
            ),
        )
        legend_above(ax)
    add_title(picture, f"{title}: steps, with the time to stay within 2 %")
    return picture
