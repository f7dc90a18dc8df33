"""Tables and pictures of constraints, perturbed plants and Pareto fronts."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..analysis.constraints import CONSTRAINTS
from ..solve.problem import FAILED_LOSS
from ..tuning.result import FrontPoint, Perturbed, Result
from .figures import AFTER, BEFORE, add_title, figure, plain_tick_labels, small_units


def constraints_table(result: Result) -> Table:
    """Return a table of limits, values reached, and held-out plants that keep them."""
    table = Table(
        title="limits on the worst plant of the search, or within the model's error"
    )
    table.add_column("limit")
    for name in ("set", "tuned", "state", "held-out plants"):
        table.add_column(name, justify="right", no_wrap=True)
    unseen = result.perturbed.constraints if result.perturbed else {}
    for name, kept in result.constraints.items():
        state = "missed" if not kept.kept else "active" if kept.active else "kept"
        held_out = unseen.get(name)
        table.add_row(
            f"{name}, {kept.sense}",
            CONSTRAINTS[name].quantity(kept.limit),
            _number(name, kept.value),
            state,
            f"{_number(name, held_out.value)}, kept on {held_out.on} of {held_out.of}"
            if held_out
            else "-",
        )
    return table


def front_table(
    front: Sequence[FrontPoint], constraint: str, units: Iterable[str]
) -> Table:
    """Return the table of the points of a Pareto front; ``units`` are those of axes."""
    shown = f"error, {small_units(units)}"
    table = Table(title="Pareto front")
    for name in (f"{constraint} limit", "reached", shown, "objective"):
        table.add_column(name, justify="right", no_wrap=True)
    for point in front:
        error, failed = point.geomean_rms_um, point.loss >= FAILED_LOSS
        table.add_row(
            f"{point.limit:.4g}",
            _number(constraint, point.value) + ("" if point.kept else ", missed"),
            "diverges" if error is None else f"{1e3 * error:.2f}",
            "failed" if failed else f"{point.loss:.3f}",
        )
    return table


def perturbed_figure(
    perturbed: Perturbed | None, title: str, units: Iterable[str]
) -> Figure | None:
    """Draw the distributions of errors and constrained figures on held-out plants.

    ``units`` are those of the axes.
    """
    if perturbed is None or not perturbed.geomeans_um:
        return None
    limited = list(perturbed.values)
    picture = figure(3.6 * (1 + len(limited)), 3.2)
    panels = picture.subplots(1, 1 + len(limited), squeeze=False)[0]
    panel = panels[0]
    for name, values, colour in (
        ("before", perturbed.geomeans_before_um, BEFORE),
        ("tuned", perturbed.geomeans_um, AFTER),
    ):
        errors = [1e3 * value for value in values if value is not None]
        lost = len(values) - len(errors)
        label = f"{name}, unstable on {lost}" if lost else name
        _distribution(panel, errors, perturbed.plants, color=colour, label=label)
    panel.set_xscale("log")
    plain_tick_labels(panel.xaxis)
    unit = small_units(units)
    panel.set_xlabel(f"rms error, geometric mean over references, {unit}")
    panel.set_ylabel(f"share of {perturbed.plants} held-out plants, %")
    panel.legend()
    for panel, name in zip(panels[1:], limited, strict=True):
        known = [value for value in perturbed.values[name] if value is not None]
        values = [value for value in known if value < CONSTRAINTS[name].unlimited]
        kept, lost = perturbed.constraints[name], len(known) - len(values)
        label = f"tuned, unlimited on {lost}" if lost else "tuned"
        _distribution(panel, values, perturbed.plants, color=AFTER, label=label)
        panel.axvline(kept.limit, color="0.3", ls="--", label=f"limit, {kept.sense}")
        panel.set_xlabel(_constraint_label(name))
        panel.legend()
    add_title(picture, title)
    return picture


def _distribution(panel: Any, values: Sequence[float], of: int, **style: Any) -> None:
    share = 100.0 * np.arange(1, len(values) + 1) / of
    panel.step(np.sort(values), share, where="post", **style)
    panel.set_ylim(0.0, 102.0)


def front_figure(
    front: Sequence[FrontPoint] | None,
    constraint: str | None,
    title: str,
    units: Iterable[str],
) -> Figure | None:
    """Draw the error against the constrained figure along a Pareto front.

    ``units`` are those of the axes.
    """
    if not front or constraint is None:
        return None
    drawn = [
        (p.value, 1e3 * p.geomean_rms_um, p.kept)
        for p in front
        if p.geomean_rms_um is not None and p.value is not None
    ]
    if not drawn:
        return None
    picture = figure(4.6, 3.4)
    panel = picture.subplots()
    for kept, style, label in ((True, "o-", "limit kept"), (False, "x", "missed")):
        points = [(x, y) for x, y, inside in drawn if inside is kept]
        if points:
            colour = AFTER if kept else BEFORE
            panel.plot(*zip(*points, strict=True), style, color=colour, label=label)
    panel.set_xlabel(f"{_constraint_label(constraint)} on the worst plant tuned on")
    panel.set_ylabel(
        f"rms error on the nominal plant,\ngeometric mean, {small_units(units)}"
    )
    panel.legend()
    add_title(picture, title)
    return picture


def _constraint_label(constraint: str) -> str:
    unit = CONSTRAINTS[constraint].unit
    name = constraint.replace("_", " ")
    return name if unit == "1" else f"{name}, {unit}"


def _number(constraint: str, value: float | None) -> str:
    return "-" if value is None else CONSTRAINTS[constraint].number(value)
