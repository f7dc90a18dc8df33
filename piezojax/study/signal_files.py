"""Signals in files that a study names, in the units of its axes."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.conversion import factor
from ..identification.records.formats import read_columns
from ..identification.records.sampled import (
    Key,
    is_clock,
    read_plain_columns,
    read_sampled,
)
from .file_tables import NoiseFile, SignalFile
from .schema import Study


class FileSignals(NamedTuple):
    """Signals of a file by axis, each in the unit of its axis.

    ``values`` [samples, axes] are 0 for an axis without a column; ``instants`` (s)
    [samples] begin at 0 and ``dt`` is their mean step; ``columns`` are the names of the
    columns by axis, "" for an axis without one.
    """

    values: Float[np.ndarray, "samples axes"]
    instants: Float[np.ndarray, " samples"]
    dt: float
    columns: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.instants[-1])


def read_signals(
    table: SignalFile,
    study: Study,
    folder: Path,
    where: str,
    units: Sequence[str],
    *,
    even: bool = True,
) -> FileSignals:
    """Return the signals of ``table`` in ``units``; ``where`` is its key in ``study``.

    The file lies in ``folder``; ``units`` are those of the axes. With ``even`` the
    samples must be evenly spaced. Raises ValueError, starting with ``where``, for an
    unreadable file, an axis without a column, and units that are unknown, contradict
    each other or cannot be converted.
    """
    path = folder / table.file
    try:
        keys = _columns(table, study, path)
        read = read_sampled(
            path, {"column": list(keys.values())}, time=table.time, rate=table.rate,
            even=even,
        )  # fmt: skip
        names = dict(zip(keys, read.names["column"], strict=True))
        values = np.zeros((read.instants.size, len(units)))
        for axis, name in names.items():
            known = _factor(name, read.units[name], table.unit, units[axis])
            values[:, axis] = table.scale * known * read.values[name]
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    return FileSignals(
        values,
        read.instants - read.instants[0],
        read.dt,
        tuple(names.get(axis, "") for axis in range(len(units))),
    )


_DENSITY = re.compile(r"(\w+?)\s*(/\s*(?:sqrt\(Hz\)|rtHz|Hz\^0\.5)|\^?2\s*/\s*Hz)")
"""Unit of an amplitude density, such as um/sqrt(Hz), or a power density, um^2/Hz."""

LEAST_LINES = 3


def read_densities(
    table: NoiseFile, study: Study, folder: Path, where: str, units: Sequence[str]
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, "lines axes"]]:
    """Return the spectra of ``table``: frequencies (Hz), one-sided power densities.

    The densities are in the square of each of ``units`` over Hz, 0 for an axis without
    a column. A line at 0 Hz is left out. Raises ValueError, starting with ``where``, as
    ``read_signals`` does, and for lines that do not increase or are below 0.
    """
    path = folder / table.file
    try:
        if table.frequency is None or table.time is not None or table.rate is not None:
            raise ValueError("a spectrum has a frequency and neither time nor rate")
        keys = _columns(table, study, path)
        roles = {"frequency": table.frequency, "column": list(keys.values())}
        names, values, known = read_plain_columns(path, roles)
        (line,) = names["frequency"]
        frequency = values[line]
        if known[line] not in (None, "Hz"):
            raise ValueError(f"column {line!r} is in {known[line]}; it must be in Hz")
        levels = np.zeros((frequency.size, len(units)))
        for axis, name in zip(keys, names["column"], strict=True):
            squared = _density(name, known[name], table.unit, units[axis])
            levels[:, axis] = squared(table.scale * values[name])
            if np.any(values[name] < 0.0):
                raise ValueError(f"column {name!r} is below 0 at a frequency")
        kept = frequency != 0.0
        frequency, levels = frequency[kept], levels[kept]
        if frequency.size < LEAST_LINES:
            raise ValueError(
                f"the file has {frequency.size} lines; it must have at least "
                f"{LEAST_LINES}"
            )
        if frequency[0] < 0.0 or np.any(np.diff(frequency) <= 0.0):
            raise ValueError("the frequencies must be above 0 and increase")
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    return frequency, levels


def _density(
    name: str, known: str | None, given: str | None, wanted: str
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from the column ``name`` to a power density."""
    if known is not None and _DENSITY.fullmatch(known) is None:
        known = None  # such as um in the name of a column of um/sqrt(Hz)
    unit = given if known is None else known
    found = _DENSITY.fullmatch(unit or "")
    if found is None:
        raise ValueError(
            f"the unit of column {name!r} is {unit or 'not known'}: set unit to "
            f'"{wanted}/sqrt(Hz)" or "{wanted}^2/Hz"'
        )
    if known is not None and given is not None and known != given:
        raise ValueError(f"column {name!r} is in {known} in the file, not in {given}")
    ratio = _factor(name, found[1], None, wanted)
    power = "2" in found[2]
    return lambda level: ratio**2 * (level if power else level**2)


def _columns(table: SignalFile, study: Study, path: Path) -> dict[int, Key]:
    """Return the column of each axis that has one, by the number of the axis."""
    if study.axes is None:
        if table.axes:
            raise ValueError("axes is for a stage with several axes; give column")
        return {0: _only_column(table, path) if table.column is None else table.column}
    names = study.axes.names
    for name in table.axes:
        if name not in names:
            raise ValueError(
                f"axes.{name} is not an axis; there are {', '.join(names)}"
            )
    if table.column is not None or not table.axes:
        raise ValueError(
            "the stage has several axes: give the column of each, as in "
            f'axes = {{ {names[0]} = "{names[0]}_{study.axes.units[0]}" }}'
        )
    return {names.index(name): key for name, key in table.axes.items()}


def _only_column(table: SignalFile, path: Path) -> Key:
    """Return the only column besides that of the time."""
    columns = read_columns(path)
    clock = list(columns)[table.time] if isinstance(table.time, int) else table.time
    others = [n for n in columns if n != clock and not is_clock(n, columns[n])]
    if len(others) != 1:
        raise ValueError(f"name the column: {path.name} has {', '.join(columns)}")
    return others[0]


def _factor(name: str, known: str | None, given: str | None, wanted: str) -> float:
    """Return the factor from the unit of the column ``name`` to ``wanted``.

    ``known`` is its unit in the file, ``given`` that of the study.
    """
    if known is not None and given is not None and known != given:
        raise ValueError(
            f"column {name!r} is in {known} in the file, but unit is {given}: leave "
            "unit out, or rename the column"
        )
    unit = known or given
    if unit is None:
        raise ValueError(
            f"the unit of column {name!r} is not known: set unit, or name the column "
            f"{name}_{wanted}"
        )
    found = factor(unit, wanted)
    if found is None:
        raise ValueError(
            f"column {name!r} is in {unit}, and {wanted} is needed: scale it, and name "
            "it with its unit"
        )
    return found
