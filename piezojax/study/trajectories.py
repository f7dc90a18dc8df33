"""Trajectories in files as references of a study."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .file_tables import TrajectoryTable
from .schema import Study
from .signal_files import FileSignals, read_signals

UNEVEN = 1e-3
"""Relative scatter of time steps above which a note calls them uneven."""


class Trajectory(NamedTuple):
    """Trajectory at the instants of a study [samples, axes], in the units of its axes.

    ``note`` tells how it was resampled and which part of the file it is.
    """

    values: Float[np.ndarray, "samples axes"]
    note: str


def read_trajectories(study: Study, folder: Path) -> dict[str, Trajectory]:
    """Read the trajectories of ``study`` from their files, which lie in ``folder``.

    Between two samples of the file the reference is linear. Raises ValueError, naming
    the key, for a file that cannot be read or ends too early, and for a part of a file
    that both a tuning and an unseen reference use.
    """
    table, units = study.references, study.axes.units if study.axes else ("um",)
    time_s = study.dt * np.arange(round(table.duration * study.rate))
    found, parts = {}, {}
    for name, trajectory in table.files.items():
        where = f"references.files.{name}"
        signals = read_signals(trajectory, study, folder, where, units, even=False)
        found[name] = _at(time_s, signals, trajectory, study, where)
        end = min(trajectory.start + time_s[-1], signals.duration)
        if trajectory.then == "repeat":
            end = signals.duration
        key = (folder / trajectory.file).resolve(), set(signals.columns) - {""}
        parts[name] = key, (trajectory.start, end)
    _check_unseen(study, parts)
    return found


def _at(
    time_s: np.ndarray,
    signals: FileSignals,
    table: TrajectoryTable,
    study: Study,
    where: str,
) -> Trajectory:
    """Return the trajectory at the instants ``time_s`` of the study."""
    left, needed = signals.duration - table.start, float(time_s[-1])
    if left <= 0.0:
        raise ValueError(
            f"{where}.start is {table.start:g} s; {table.file.name} ends after "
            f"{signals.duration:.6g} s"
        )
    # A reference of N samples lasts N - 1 steps; it may end one step after the file.
    short = left + signals.dt < needed
    if short and table.then is None:
        raise ValueError(
            f"{where}: {table.file.name} holds {left:.6g} s from its start, and the "
            f"reference lasts {needed:.6g} s: shorten references.duration, or set "
            'then = "hold" or then = "repeat"'
        )
    instants, source = signals.instants, signals.values
    places = table.start + time_s
    if short and table.then == "repeat":
        # One step leads from the last sample back to the start.
        first = [np.interp(table.start, instants, column) for column in source.T]
        source = np.concatenate([source, [first]])
        instants = np.append(instants, signals.duration + signals.dt)
        places = table.start + np.mod(time_s, left + signals.dt)
    values = np.stack([np.interp(places, instants, c) for c in source.T], axis=1)
    offsets = np.array(study.by_axis(table.offset))
    driven = np.array([bool(name) for name in signals.columns])
    resting = np.array(study.by_axis(study.references.offset))
    values = np.where(driven, values + offsets, resting)
    for axis in np.flatnonzero(driven):
        if np.ptp(values[:, axis]) == 0.0:
            raise ValueError(
                f"{where}: column {signals.columns[axis]!r} never changes from "
                f"{table.start:g} s on"
            )
    return Trajectory(values, f"{where}: {_note(signals, table, study, left, needed)}")


def _note(
    signals: FileSignals,
    table: TrajectoryTable,
    study: Study,
    left: float,
    needed: float,
) -> str:
    rate, steps = 1.0 / signals.dt, np.diff(signals.instants)
    uneven = np.ptp(steps) > UNEVEN * signals.dt
    source = f"{signals.instants.size} samples of {table.file.name}"
    if uneven:
        source += f" with uneven steps of {steps.min():.4g} to {steps.max():.4g} s"
    else:
        source += f" at {rate:.6g} Hz"
    same = not uneven and np.isclose(rate, study.rate, rtol=1e-6)
    text = source if same else f"{source}, interpolated linearly at {study.rate:g} Hz"
    if rate > 1.001 * study.rate:
        text += " (samples between those of the study are left out)"
    end = min(table.start + needed, signals.duration)
    text += f"; {table.start:.6g} to {end:.6g} s of {signals.duration:.6g} s"
    if left + signals.dt < needed:
        text += ", then " + (
            "its last value held" if table.then == "hold" else "repeated"
        )
    return text


def _check_unseen(study: Study, parts: Mapping) -> None:
    """Raise ValueError if an unseen reference shares samples with a tuning one."""
    table = study.references
    for seen, unseen in product(table.tune, table.unseen):
        if seen not in parts or unseen not in parts:
            continue
        (file, columns), (start, end) = parts[seen]
        (other, others), (begin, stop) = parts[unseen]
        if file == other and columns & others and begin < end and start < stop:
            raise ValueError(
                f"references.unseen: {unseen} shares the samples from "
                f"{max(start, begin):g} to {min(end, stop):g} s of {file.name} with "
                f"{seen}, which is used in tuning: change the start of one of them"
            )
