"""Growth of time and memory of simulated loops and of their gradients.

    python tests/benchmarks/growth.py --json growth.json --out growth.png

Loops (growth_loops.py) run on one core as in a search, with a growing number of

    lanes        loop "dob_pid_smc" of throughput.py, with 8 gains
    samples      the same loop
    states       PID and a stage with Prandtl-Ishlinskii hysteresis of that many plays
    parameters   FIR feedforward of 64 taps and PID; that many taps are tuned
    axes         PID on each axis of a stage with coupled axes of 3 states each

The JSON file has a row for each point and curve, measured in a new process:

    what              "run", or "reverse" or "forward": value and gradient in this mode
    against, value    what grows, and its value
    seconds           shortest of several runs, because other load only adds time
    extra_memory_mb   growth of resident memory during a run (10^6 bytes), inputs and
                      compiled code not counted; differences below 0.1 are not resolved
    compile_s         tracing and compiling
    compiled_c        whether the loop runs in compiled C; if not, XLA runs it

``slopes`` are those of straight lines through the upper half of the points on
logarithmic axes: 1 is linear. ``--panels lanes,axes`` measures only these.
"""

import throughput  # first: it prevents threads of libraries  # isort: skip
import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import growth_loops as loops
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import NullFormatter
from piezojax_engine import mean_square, value_and_gradient
from rich.console import Console
from rich.table import Table

from piezojax.core.feedback import holding_input
from piezojax.report.figures import AFTER, BEFORE, REFERENCE, figure, plot_style, write

REPEATS = 5
FEWEST = 3
"""Smallest number of points for a slope."""

RESOLVED_MB = 0.1
"""Smallest memory that is drawn and fitted; lower values are drawn here."""


class Panel(NamedTuple):
    """Values on an axis with that ``label``, the curves, and the loop of a value.

    The axis is labelled at ``ticks``, without any at each decade.
    """

    label: str
    values: tuple[int, ...]
    curves: tuple[str, ...]
    problem: Callable[[int], loops.Problem]
    ticks: Sequence[int] = ()


PANELS = {
    "lanes": Panel(
        f"lanes ({loops.SAMPLES} samples)",
        (1, 2, 4, 8, 16, 32, 64, 256, 1024, 4096),
        ("run", "reverse"),
        lambda lanes: loops.by_size(lanes, loops.SAMPLES),
        (1, 8, 64, 512, 4096),
    ),
    "samples": Panel(
        f"samples ({loops.FEW_LANES} lanes)",
        (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000),
        ("run", "reverse"),
        lambda samples: loops.by_size(loops.FEW_LANES, samples),
    ),
    "states": Panel(
        "plays, one state each",
        (5, 10, 20, 40, 80, 160, 320),
        ("run", "reverse"),
        loops.by_plays,
        (5, 10, 20, 40, 80, 160, 320),
    ),
    "parameters": Panel(
        f"tuned taps of {loops.TAPS}",
        (1, 2, 4, 8, 16, 32, 64),
        ("reverse", "forward"),
        loops.by_taps,
        (1, 2, 4, 8, 16, 32, 64),
    ),
    "axes": Panel(
        "coupled axes",
        (1, 2, 3, 4, 6, 8),
        ("run", "reverse"),
        loops.by_axes,
        (1, 2, 3, 4, 6, 8),
    ),
}

CURVES = {
    "run": ("run", AFTER, "o"),
    "reverse": ("reverse gradient", BEFORE, "s"),
    "forward": ("forward gradient", REFERENCE, "^"),
}
"""Label, colour and marker."""

QUANTITIES = {
    "seconds": "time (s)",
    "extra_memory_mb": "extra memory (MB)",
    "compile_s": "compile time (s)",
}
"""Label of each row of panels."""


# Measurement


def gradient_in_forward_mode(loop_of, gains, inputs, holding):
    """Return the loss and its gradient [n], in forward mode as in a search."""

    def slope(direction):
        loss = lambda g: mean_square(loop_of, g, inputs, holding)  # noqa: E731
        return jax.jvp(loss, (gains,), (direction,))

    return jax.vmap(slope, out_axes=(None, 0))(jnp.eye(gains.size))


FUNCTIONS = {
    "run": mean_square,
    "reverse": value_and_gradient,
    "forward": gradient_in_forward_mode,
}


def measured(against, value):
    """Return the rows of a point; call it in a new process."""
    loop_of, gains, inputs = PANELS[against].problem(value)
    first = jax.tree.map(lambda x: x[0, 0], inputs.next_reference)
    arguments = gains, inputs, holding_input(loop_of(gains).plant, first)
    rows, runs = [], []
    for what in PANELS[against].curves:
        begin = time.perf_counter()
        lowered = jax.jit(partial(FUNCTIONS[what], loop_of)).lower(*arguments)
        compiled = lowered.compile()
        compile_s = time.perf_counter() - begin
        runs.append(partial(run, compiled, arguments))
        calls = throughput.SHORTEST_SAMPLE_S / throughput.seconds_of(runs[-1])
        samples = [
            throughput.seconds_of(runs[-1], math.ceil(calls)) for _ in range(REPEATS)
        ]
        rows.append(
            {
                "what": what,
                "against": against,
                "value": value,
                "seconds": min(samples),
                "compile_s": compile_s,
                "compiled_c": "piezojax_" in lowered.as_text(),
            }
        )
    for row, each in zip(rows, runs, strict=True):
        row["extra_memory_mb"] = throughput.growth_of_memory_mb(each)
    return rows


def run(compiled, arguments):
    return jax.block_until_ready(compiled(*arguments))


def curve(rows, what, against, quantity):
    """Return values and measurements of a curve."""
    found = [row for row in rows if (row["what"], row["against"]) == (what, against)]
    return (
        np.array([row["value"] for row in found], float),
        np.array([row[quantity] or 0.0 for row in found]),
    )


def fitted(x, y, quantity):
    """Return slope, x and y of a line through the upper half, or None.

    It is a power of x; there is none without FEWEST points that are resolved.
    """
    half = len(x) // 2
    x, y = x[half:], y[half:]
    if quantity == "extra_memory_mb":
        x, y = x[y > RESOLVED_MB], y[y > RESOLVED_MB]
    if len(x) < FEWEST:
        return None
    slope, level = np.polyfit(np.log(x), np.log(y), 1)
    return float(slope), x, np.exp(level) * x**slope


def slopes(rows):
    """Return the slope of each curve, None without one."""
    found = []
    for against in dict.fromkeys(row["against"] for row in rows):
        for what in PANELS[against].curves:
            for quantity in QUANTITIES:
                fit = fitted(*curve(rows, what, against, quantity), quantity)
                each = {"what": what, "against": against, "quantity": quantity}
                found.append(each | {"slope": fit and fit[0]})
    return found


# Results


def draw(ax, rows, against, quantity):
    """Draw the curves of a panel, with their slopes in its legend."""
    panel = PANELS[against]
    for what in panel.curves:
        name, colour, marker = CURVES[what]
        x, y = curve(rows, what, against, quantity)
        fit = fitted(x, y, quantity)
        if fit:
            ax.plot(*fit[1:], color=colour, lw=3.0, alpha=0.3)
            name = f"{name}, slope {fit[0]:.2f}"
        elif quantity == "extra_memory_mb":
            name = f"{name}, at most {max(RESOLVED_MB, *y):.1f} MB"
        if quantity == "extra_memory_mb":
            y = np.maximum(y, RESOLVED_MB)
        ax.plot(x, y, marker, ls="-", color=colour, lw=0.9, ms=3.5, label=name)
    ax.set(xscale="log", yscale="log")
    ax.legend(loc="upper left", fontsize=7.5, borderaxespad=0.2, handlelength=1.6)


def label_ticks(ax, ticks):
    """Label an axis of x at ``ticks``, or at each decade if there are none."""
    ax.xaxis.set_minor_formatter(NullFormatter())
    if ticks:
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()


def picture(rows):
    """Return the picture: a column for each number that grows."""
    columns = list(dict.fromkeys(row["against"] for row in rows))
    drawn = figure(2.7 * len(columns), 2.3 * len(QUANTITIES))
    panels = drawn.subplots(
        len(QUANTITIES), len(columns), sharex="col", sharey="row", squeeze=False
    )
    for line, (quantity, label) in zip(panels, QUANTITIES.items(), strict=True):
        line[0].set_ylabel(label)
        for ax, against in zip(line, columns, strict=True):
            draw(ax, rows, against, quantity)
        low, high = line[0].get_ylim()
        line[0].set_ylim(low, high * (high / low) ** 0.2)  # room for the legends
    for column, against in zip(panels.T, columns, strict=True):
        column[0].set_title(against)
        column[-1].set_xlabel(PANELS[against].label)
        label_ticks(column[-1], PANELS[against].ticks)
    return drawn


def table(found):
    shown = Table(title="slopes, one core")
    for column in ("against", "what", *QUANTITIES):
        shown.add_column(column)
    by_curve = {}
    for each in found:
        key = each["against"], each["what"]
        by_curve.setdefault(key, []).append(each["slope"])
    for key, values in by_curve.items():
        shown.add_row(*key, *("-" if v is None else f"{v:.2f}" for v in values))
    return shown


def parse(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    names = throughput.names_among(PANELS, "panel")
    parser.add_argument("--panels", type=names, default=list(PANELS))
    options = parser.parse_args(arguments)
    for path in (options.json, options.out):
        if not path.absolute().parent.is_dir():
            parser.error(f"no folder {path.parent}")
    return options


def main(arguments=None):
    options = parse(arguments)
    throughput.pin_to_one_core()
    console, rows = Console(), []
    for against in options.panels:
        for value in PANELS[against].values:
            rows += throughput.in_fresh_process(measured, against, value)
            for row in rows[-len(PANELS[against].curves) :]:
                console.print(
                    f"{value} {against}, {row['what']}: {row['seconds']:.3g} s, "
                    f"{row['extra_memory_mb'] or 0.0:.1f} MB, "
                    f"compiled in {row['compile_s']:.1f} s",
                    highlight=False,
                )
    found = slopes(rows)
    result = {"rows": rows, "slopes": found, "versions": throughput.versions()}
    options.json.write_text(json.dumps(result, indent=2) + "\n")
    with plot_style():
        write(picture(rows), options.out)
    console.print(table(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
