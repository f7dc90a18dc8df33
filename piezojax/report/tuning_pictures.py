"""Pictures and files of a tuning run."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ..core.axes import axis_of
from ..core.files import seen_from, write_report, write_text
from ..core.serial import save
from ..signals.waveforms import parse
from ..study import Study, as_toml
from ..tuning.contouring import contour_errors, contours_in
from ..tuning.outcome import Logs, Outcome, tracking_rms
from ..tuning.result import GAINS_FILE, RESULT_FILE, STUDY_FILE
from ..tuning.traces import Trace, traces_of
from .contour_path import contour_figure
from .coupling_map import coupling_figure
from .figures import (
    AFTER,
    BEFORE,
    REFERENCE,
    UNITS,
    Pictures,
    add_title,
    figure,
    legend_above,
    plain_tick_labels,
    plot_style,
    write,
)
from .robustness import front_figure, perturbed_figure
from .step_pictures import steps_figure
from .structure_pictures import structures_figure

_MOST_TRACES = 3  # largest number in the tracking picture
_PERIODS = 4.0  # periods of the reference that are drawn, at the end of the run


def write_results(outcome: Outcome, folder: Path) -> Pictures:
    """Write gains.toml, study.toml, result.json and the pictures into ``folder``.

    A stage with several axes also has pictures of their coupling, and of the contours
    if the study has any. Returns the pictures.
    """
    drawn: Pictures = {}
    write_numbers(outcome, folder)
    study, result = outcome.case.study, outcome.result
    shown = _drawn_traces(outcome)
    chosen = {trace.run for trace in shown} | {c.run for c in contours_in(study)}
    runs = outcome.logs(chosen)
    logs = {trace: _axis_logs(study, trace, runs[trace.run]) for trace in shown}
    with plot_style():
        pictures = {
            "tracking.png": tracking_figure(outcome, logs),
            "hysteresis.png": hysteresis_figure(outcome, logs),
            "convergence.png": convergence_figure(outcome) if result.history else None,
            "coupling.png": coupling_figure(outcome.coupling, result.heading),
            "contour.png": contour_figure(
                study, result.heading, contour_errors(study, runs)
            ),
            "steps.png": steps_figure(outcome.step_runs, outcome.steps, result.heading)
            if outcome.steps[1]
            else None,
            "structures.png": structures_figure(result.structures, result.heading),
            "robustness.png": perturbed_figure(
                result.perturbed, result.heading, result.units.values()
            ),
            "pareto.png": front_figure(
                result.front,
                study.pareto.constraint if study.pareto else None,
                result.heading,
                result.units.values(),
            ),
        }
        for name, picture in pictures.items():
            if picture:
                drawn |= write(picture, folder / name)
    return drawn


def write_numbers(outcome: Outcome, folder: Path) -> None:
    """Write gains.toml, study.toml and result.json into ``folder``, in this order.

    Relative names of files in study.toml are relative to ``folder``.
    """
    case = outcome.case
    save(outcome.controller, folder / GAINS_FILE, outcome.about)

    def moved(file: str) -> str:
        path = Path(file)
        return file if path.is_absolute() else seen_from(folder, case.folder / path)

    write_text(folder / STUDY_FILE, as_toml(case.study, moved))
    before, after = outcome.drive
    found = {"drive_before": before, "drive": after}
    result = outcome.result.model_copy(update=found)
    write_report(folder / RESULT_FILE, result)


def _quantity(trace: Trace) -> str:
    return "rotation" if trace.unit == "urad" else "displacement"


def _axis_logs(study: Study, trace: Trace, both: Logs) -> Logs:
    if not study.axes:
        return both
    before, after = (axis_of(log, trace.axis) for log in both)
    return before, after


def _drawn_traces(outcome: Outcome) -> list[Trace]:
    """Return the traces to draw, ``_MOST_TRACES`` at most.

    For each axis and kind of signal, only the trace with the largest error before
    tuning is considered.
    """
    errors = outcome.result.before.per_reference_rms_um
    study = outcome.case.study
    by_kind: dict[tuple[int, str], Trace] = {}
    for trace in traces_of(study):
        if trace.name not in errors:
            continue
        signal = _signal_of(study, trace)
        in_file = signal in study.references.files
        place = trace.axis, signal if in_file else parse(signal)[0]
        current = by_kind.get(place)
        error = errors[trace.name] or np.inf
        if current is None or error > (errors[current.name] or np.inf):
            by_kind[place] = trace
    # With several axes, one trace of each axis comes before a second one of any.
    first = {trace.axis: trace for trace in reversed(by_kind.values())}
    rest = [trace for trace in by_kind.values() if trace not in first.values()]
    return [*(first[axis] for axis in sorted(first)), *rest][:_MOST_TRACES]


def _signal_of(study: Study, trace: Trace) -> str:
    """Return the name of the signal that drives the axis of a trace."""
    run = (*study.references.tune, *study.references.unseen)[trace.run]
    axis = study.axes.names[trace.axis] if study.axes else ""
    return study.driven(run)[axis]


def _drawn_from(study: Study, trace: Trace) -> float:
    """Return the time (s) from which a trace is drawn."""
    table, signal = study.references, _signal_of(study, trace)
    if signal in table.files:
        return table.settle
    frequency = parse(signal)[1] or 1.0
    return max(table.settle, table.duration - _PERIODS / frequency)


def tracking_figure(outcome: Outcome, logs: dict[Trace, Logs]) -> Figure:
    """Draw displacement and error against time, before and after tuning."""
    study = outcome.case.study
    table, dt = study.references, study.dt
    picture = figure(9.0, 2.3 * len(logs) + 0.4)
    axes = picture.subplots(len(logs), 2, squeeze=False)
    for (trace, (before, after)), (left, right) in zip(logs.items(), axes, strict=True):
        unit, small = UNITS[trace.unit]
        right.sharex(left)
        time = np.arange(before.reference.size) * dt
        shown = time >= _drawn_from(study, trace)
        for log, colour, label in ((before, BEFORE, "before"), (after, AFTER, "tuned")):
            error = 1e3 * (log.displacement - log.reference)
            rms = 1e3 * tracking_rms(log, round(table.settle / dt))
            left.plot(time[shown], log.displacement[shown], color=colour, label=label)
            right.plot(
                time[shown],
                error[shown],
                color=colour,
                lw=0.9,
                label=f"{label}, {rms:.4g} {small} rms" if np.isfinite(rms) else label,
            )
        left.plot(
            time[shown],
            before.reference[shown],
            color=REFERENCE,
            ls="--",
            lw=0.9,
            label="reference",
        )
        left.set(ylabel=f"{trace.name}\n{_quantity(trace)} ({unit})")
        right.set(ylabel=f"tracking error ({small})")
        left.locator_params(axis="x", nbins=5)
        legend_above(left)
        legend_above(right)
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")
    add_title(picture, f"{outcome.result.heading}: hold-out, first draw of the noise")
    return picture


def hysteresis_figure(outcome: Outcome, logs: dict[Trace, Logs]) -> Figure:
    """Draw the hysteresis of the stage, and the error that remains in closed loop."""
    table, dt = outcome.case.study.references, outcome.case.study.dt
    trace = next(iter(logs))
    name, (before, after) = trace.name, logs[trace]
    unit, small = UNITS[trace.unit]
    drive = "command" if outcome.case.study.axes else "voltage"
    drive_unit = unit if outcome.case.study.axes else "V"
    settled = np.arange(before.reference.size) * dt >= table.settle
    picture = figure(9.0, 3.4)
    left, right = picture.subplots(1, 2)
    left.plot(after.voltage[settled], after.displacement[settled], color=AFTER)
    left.set(
        xlabel=f"{drive} ({drive_unit})",
        ylabel=f"{_quantity(trace)} ({unit})",
        title=f"{name}: {_quantity(trace)} over {drive}, tuned loop",
    )
    for log, colour, label in ((before, BEFORE, "before"), (after, AFTER, "tuned")):
        error = 1e3 * (log.displacement - log.reference)
        right.plot(
            log.reference[settled], error[settled], color=colour, lw=0.9, label=label
        )
    right.set(
        xlabel=f"reference ({unit})",
        ylabel=f"{_quantity(trace)} minus reference ({small})",
        title=f"{name}: error in closed loop\n",
    )
    legend_above(right)
    return picture


def convergence_figure(outcome: Outcome) -> Figure:
    """Draw the objective of each start against steps; the best start is thick."""
    history = np.array(outcome.result.history, dtype=float)
    geometric = outcome.case.study.objective.aggregate == "geometric_mean"
    shown = np.exp(history) if geometric else history
    # If no start met the limits, none is the best.
    last = history[-1]
    best = int(np.nanargmin(last)) if np.isfinite(last).any() else -1
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
        # On several axes the errors of axes at rest count as well, with their weight.
        joined = (
            "errors of all axes, at rest too,\nweighted geometric mean"
            if outcome.case.study.axes
            else "error, geometric mean of all\nreferences"
        )
        ax.set(ylabel=f"{joined}, relative to before (-)", yscale="log")
        plain_tick_labels(ax.yaxis)
    else:
        ax.set(ylabel="objective (-)")
    ax.set(xlabel=f"step of {outcome.result.method}", title="Convergence")
    ax.locator_params(axis="x", integer=True)
    ax.legend()
    return picture
