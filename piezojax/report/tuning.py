"""Pictures and files of a tuning run."""

from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from .. import signals
from ..files import write_text
from ..rollout import simulate
from ..serial import save
from ..system import LoopSample, loop_inputs
from ..tune.result import GAINS_FILE, RESULT_FILE
from ..tune.tuner import Outcome
from .figures import AFTER, BEFORE, REFERENCE, figure, legend_above, styled, write

_SHOWN = 3  # references in the tracking picture
_BEYOND = 1e9  # um or V
_PERIODS = 4.0  # of the reference, at the end of the run


def write_results(outcome: Outcome, folder: Path) -> None:
    """Write result.json, gains.toml and the pictures into ``folder``."""
    write_numbers(outcome, folder)
    logs = _logs(outcome)
    with styled():
        write(tracking_figure(outcome, logs), folder / "tracking.png")
        write(hysteresis_figure(outcome, logs), folder / "hysteresis.png")
        if outcome.result.history:
            write(convergence_figure(outcome), folder / "convergence.png")


def write_numbers(outcome: Outcome, folder: Path) -> None:
    """Write result.json and gains.toml into ``folder``."""
    write_text(folder / RESULT_FILE, outcome.result.model_dump_json(indent=2) + "\n")
    save(outcome.controller, folder / GAINS_FILE)


Logs = dict[str, tuple[LoopSample, LoopSample]]


def _logs(outcome: Outcome) -> Logs:
    """Run both loops over the shown references, as in the hold-out."""

    @jax.jit
    def run(loop, reference, noise):
        inputs = loop_inputs(reference, noise, outcome.holdout.disturbance)
        return simulate(loop, inputs, loop.init(reference[0]))[1]

    logs = {}
    names = list(outcome.result.before.per_reference_rms_um)
    for name in _shown(outcome):
        i = names.index(name)
        reference, noise = outcome.holdout.references[i], outcome.holdout.noise[i, 0]
        before, after = (
            jax.tree.map(_drawable, run(loop, reference, noise))
            for loop in (outcome.before, outcome.after)
        )
        logs[name] = (before, after)
    return logs


def _drawable(values: jax.Array) -> np.ndarray:
    # A run that diverges ends at the edge of the picture, not in an overflow.
    array = np.asarray(values)
    return np.where(np.abs(array) < _BEYOND, array, np.nan)


def _shown(outcome: Outcome) -> list[str]:
    """Pick, of each kind of signal, the one that was hardest before."""
    errors = outcome.result.before.per_reference_rms_um
    by_kind: dict[str, str] = {}
    for name, error in errors.items():
        kind = signals.parse(name)[0]
        current = by_kind.get(kind)
        if current is None or (error or np.inf) > (errors[current] or np.inf):
            by_kind[kind] = name
    return list(by_kind.values())[:_SHOWN]


def _window(name: str, duration: float, settle: float) -> float:
    frequency = signals.parse(name)[1] or 1.0
    return max(settle, duration - _PERIODS / frequency)


def tracking_figure(outcome: Outcome, logs: Logs) -> Figure:
    """Displacement and error against time, before and after."""
    table, dt = outcome.case.study.references, outcome.case.study.dt
    picture = figure(9.0, 2.3 * len(logs) + 0.4)
    axes = picture.subplots(len(logs), 2, squeeze=False)
    for (name, (before, after)), (left, right) in zip(logs.items(), axes, strict=True):
        time = np.arange(before.reference.size) * dt
        shown = time >= _window(name, table.duration, table.settle)
        for log, colour, label in ((before, BEFORE, "before"), (after, AFTER, "tuned")):
            error = 1e3 * (log.displacement - log.reference)
            rms = np.sqrt(np.mean(error[time >= table.settle] ** 2))
            left.plot(time[shown], log.displacement[shown], color=colour, label=label)
            right.plot(
                time[shown],
                error[shown],
                color=colour,
                lw=0.9,
                label=f"{label}, {rms:.4g} nm rms" if np.isfinite(rms) else label,
            )
        left.plot(
            time[shown],
            before.reference[shown],
            color=REFERENCE,
            ls="--",
            lw=0.9,
            label="reference",
        )
        left.set(ylabel=f"{name}\ndisplacement (µm)")
        right.set(ylabel="tracking error (nm)")
        legend_above(left)
        legend_above(right)
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")
    picture.suptitle(f"{outcome.result.title}: hold-out runs")
    return picture


def hysteresis_figure(outcome: Outcome, logs: Logs) -> Figure:
    """The stage's own loop, and what control leaves of it."""
    table, dt = outcome.case.study.references, outcome.case.study.dt
    name = next(iter(logs))
    before, after = logs[name]
    settled = np.arange(before.reference.size) * dt >= table.settle
    picture = figure(9.0, 3.4)
    left, right = picture.subplots(1, 2)
    left.plot(after.voltage[settled], after.displacement[settled], color=AFTER)
    left.set(
        xlabel="voltage (V)",
        ylabel="displacement (µm)",
        title=f"{name}: the stage's hysteresis, in the tuned loop",
    )
    for log, colour, label in ((before, BEFORE, "before"), (after, AFTER, "tuned")):
        error = 1e3 * (log.displacement - log.reference)
        right.plot(
            log.reference[settled], error[settled], color=colour, lw=0.9, label=label
        )
    right.set(
        xlabel="reference (µm)",
        ylabel="displacement less reference (nm)",
        title=f"{name}: what is left in closed loop\n",
    )
    legend_above(right)
    return picture


def convergence_figure(outcome: Outcome) -> Figure:
    """Objective of each start against steps, the best one drawn strong."""
    history = np.array(outcome.result.history, dtype=float)
    geometric = outcome.case.study.objective.aggregate == "geometric_mean"
    shown = np.exp(history) if geometric else history
    best = int(np.nanargmin(history[-1]))
    picture = figure(6.0, 3.6)
    ax = picture.subplots()
    steps = np.arange(1, len(shown) + 1)
    for i, line in enumerate(shown.T):
        strong = i == best
        ax.plot(
            steps,
            line,
            color=AFTER if strong else "#b9cdd4",
            lw=1.8 if strong else 0.9,
            zorder=3 if strong else 2,
            label="best start"
            if strong
            else ("other starts" if i in (0, 1) and i == (best == 0) else None),
        )
    if geometric:
        ax.axhline(1.0, color=BEFORE, lw=1.0, ls="--", label="gains before")
        ax.set(
            ylabel="error, geometric mean of all\nreferences, relative to before (-)",
            yscale="log",
        )
    else:
        ax.set(ylabel="objective (-)")
    ax.set(xlabel=f"step of {outcome.result.method}", title="Convergence")
    ax.legend()
    return picture
