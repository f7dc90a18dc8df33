"""Columns of a file as uniformly or unevenly sampled signals."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .columns import Column, Columns, ContentError
from .formats import read_columns
from .units import seconds_of, unit_of

Key = str | int
"""Name of a column, or its number from zero."""

IS_TIME = re.compile(
    r"time\b|time_|x[-_ ](axis|value)\b|(?-i:t)(_[mun]?s)?(\s*[\[(].*)?$",
    re.IGNORECASE,
)
"""Pattern of the names of time columns; t is time, T may be a temperature."""

COUNTED = ("s", "ms", "us", "ns", "sequence")
"""Units, in lower case, of columns that count time or samples."""

LONGEST = 100_000_000
"""Most samples of resampled signals."""

UNIFORM = 1e-3
"""Largest relative difference of time steps that count as one sample time."""


class Sampled(NamedTuple):
    """Columns of a file by their names, with units (None if unknown) and instants.

    ``names`` are the columns of each role. ``instants`` [samples] in s are those of the
    time column, or from 0 without one; ``dt`` (s) is their mean step. ``clock`` is the
    name of a time column without a unit, "" otherwise.
    """

    names: dict[str, list[str]]
    values: dict[str, np.ndarray]
    units: dict[str, str | None]
    instants: np.ndarray
    dt: float
    clock: str

    def matrix(self, role: str) -> np.ndarray:
        """Return the columns of ``role``, [samples, columns]."""
        return np.stack([self.values[name] for name in self.names[role]], axis=1)

    def resampled(self, rate: float, path: Path) -> "Sampled":
        """Return the columns, interpolated linearly at ``rate`` (Hz).

        Raises ValueError, naming the file ``path``, for a rate that is not above 0 or
        gives too many samples.
        """
        try:
            values, dt = _resampled(self.values, self.instants, rate)
        except ContentError as error:
            raise ValueError(f"{path.name}: {error}") from None
        samples = next(iter(values.values())).size
        instants = self.instants[0] + dt * np.arange(samples)
        return self._replace(values=values, instants=instants, dt=dt)


def read_sampled(
    path: Path,
    roles: Mapping[str, Key | Sequence[Key]],
    *,
    time: Key | None = None,
    rate: float | None = None,
    even: bool = True,
    least: int = 2,
) -> Sampled:
    """Read the columns of each of ``roles`` from a file in one of ``formats.FORMATS``.

    Columns and sample time are given as for ``read_record``. Unless ``even``, the steps
    of the time column may differ. The message on a time column of fewer than two
    samples asks for ``least`` samples. Raises ValueError as ``read_record`` does.
    """
    columns = read_columns(path)
    try:
        clock = _column_names(columns, [] if time is None else [time], "time")
        names = {role: _column_names(columns, key, role) for role, key in roles.items()}
        for role, each in names.items():
            _check_signals(columns, each, role, tuple(roles))
        values = _numbers(columns, {"time": clock, **names})
        signals = [name for each in names.values() for name in each]
        steps = {f"column {n!r}": columns[n].dt for n in signals}
        if rate is not None:
            steps = {"the rate": 1.0 / _above_zero(rate, "rate")} | steps
        instants = None
        for name in clock:
            instants = values.pop(name) * seconds_of(name, columns[name])
            steps = {f"column {name!r}": _time_step(instants, even, least)} | steps
        dt = _common_step(steps)
    except ContentError as error:
        raise ValueError(f"{path.name}: {error}{response_hint(columns)}") from None
    if instants is None:
        instants = dt * np.arange(values[signals[0]].size)
    units = {name: unit_of(name, columns[name]) for name in signals}
    bare = [name for name in clock if unit_of(name, columns[name]) is None]
    return Sampled(names, values, units, instants, dt, "".join(bare))


def read_plain_columns(
    path: Path, roles: Mapping[str, Key | Sequence[Key]]
) -> tuple[dict[str, list[str]], dict[str, np.ndarray], dict[str, str | None]]:
    """Return names by role, and values and units by name, of columns without a time.

    Raises ValueError for a file that cannot be read, a missing column, missing numbers
    and columns of different length.
    """
    columns = read_columns(path)
    try:
        names = {role: _column_names(columns, key, role) for role, key in roles.items()}
        values = _numbers(columns, names)
    except ContentError as error:
        raise ValueError(f"{path.name}: {error}") from None
    return names, values, {name: unit_of(name, columns[name]) for name in values}


def response_hint(columns: Columns) -> str:
    """Return the end of a message on a file that may hold a frequency response."""
    if any(unit_of(name, column) == "Hz" for name, column in columns.items()):
        return (
            "; for a frequency response, identify and start have the option --response"
        )
    return ""


def is_clock(name: str, column: Column) -> bool:
    """Return whether a column counts time or samples, by its name or its unit."""
    unit = (unit_of(name, column) or "").lower()
    return bool(IS_TIME.match(name)) or unit in COUNTED


def _check_signals(
    columns: Columns, names: list[str], role: str, roles: Sequence[str]
) -> None:
    for name in names:
        if is_clock(name, columns[name]):
            raise ContentError(
                f"the {role} column is {name!r}; name the columns of "
                f"{' and '.join(roles)}: there are {', '.join(columns)}"
            )


def _column_names(
    columns: Columns, wanted: Key | Sequence[Key], role: str
) -> list[str]:
    """Return the names of the columns ``wanted``, given by name or number."""
    if isinstance(wanted, str) and wanted not in columns and "," in wanted:
        wanted = [key.strip() for key in wanted.split(",")]
    names = list(columns)
    found = []
    for key in [wanted] if isinstance(wanted, Key) else wanted:
        number = isinstance(key, int) or (key not in columns and key.isdecimal())
        name = dict(enumerate(names)).get(int(key)) if number else key
        if name not in columns:
            raise ContentError(
                f"{role} column {key!r} is missing; there are {', '.join(names)}"
            )
        found.append(name)
    if role != "time" and not found:
        raise ContentError(f"no {role} column is named")
    return found


def _numbers(columns: Columns, roles: dict[str, list[str]]) -> dict[str, np.ndarray]:
    """Return the columns of all ``roles`` as finite floats of one length."""
    values, role_of = {}, {}
    for role, name in ((role, name) for role, names in roles.items() for name in names):
        if name in role_of:
            raise ContentError(
                f"column {name!r} is named twice: as {role_of[name]} and as {role}"
            )
        role_of[name] = role
        values[name] = _finite(columns[name], f"{role} column {name!r}")
    if len({column.size for column in values.values()}) > 1:
        lengths = ", ".join(f"{name} {column.size}" for name, column in values.items())
        raise ContentError(f"columns differ in length: {lengths}")
    return values


def _finite(column: Column, name: str) -> np.ndarray:
    if column.fault:
        raise ContentError(f"{name}, {column.fault}")
    if column.values.dtype.kind not in "fiub":
        raise ContentError(f"{name} is {column.values.dtype}, not real numbers")
    values = column.values.astype(float)
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ContentError(
            f"{name} is missing or not finite at sample {bad[0]} ({bad.size} in all)"
        )
    return values


def _above_zero(value: float, name: str) -> float:
    if not (np.isfinite(value) and value > 0):
        raise ContentError(f"{name} is {value:g} Hz; it must be above 0")
    return value


def _time_step(time: np.ndarray, even: bool, least: int) -> float:
    """Return the mean step in s of an increasing time axis; check it for ``even``."""
    if time.size < 2:
        raise ContentError(f"{time.size} samples; at least {least} are needed")
    steps = np.diff(time)
    if np.any(steps <= 0):
        sample = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise ContentError(f"time does not increase at sample {sample}")
    dt = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - dt) > UNIFORM * dt)
    if even and uneven.size:
        sample = int(uneven[0]) + 1
        raise ContentError(
            f"time is not uniform: step {steps[sample - 1]:g} s at sample {sample}, "
            f"{dt:g} s elsewhere; --resample HZ interpolates it"
        )
    return float((time[-1] - time[0]) / (time.size - 1))


def _common_step(steps: dict[str, float | None]) -> float:
    """Return the sample time in s; check that all known values agree."""
    known = [(source, step) for source, step in steps.items() if step is not None]
    if not known:
        raise ContentError("name the time column, or give its rate in Hz")
    first, dt = known[0]
    for other, step in known:
        if abs(step - dt) > UNIFORM * dt:
            raise ContentError(
                f"the sample rate is {1.0 / dt:.6g} Hz by {first} and {1.0 / step:.6g} "
                f"Hz by {other}; they must agree within {100.0 * UNIFORM:g} %"
            )
    return dt


def _resampled(
    values: dict[str, np.ndarray], instants: np.ndarray, rate: float
) -> tuple[dict[str, np.ndarray], float]:
    """Return ``values`` on a uniform grid of ``rate`` (Hz), and the step in s."""
    dt = 1.0 / _above_zero(rate, "resample")
    # The factor keeps the last sample despite rounding.
    steps = (instants[-1] - instants[0]) / dt * (1.0 + 1e-12)
    if not steps < LONGEST:
        raise ContentError(
            f"resample is {rate:g} Hz: {instants[-1] - instants[0]:g} s would be "
            f"{steps:.3g} samples; at most {LONGEST:g} are allowed"
        )
    grid = instants[0] + dt * np.arange(int(steps) + 1)
    return {name: np.interp(grid, instants, v) for name, v in values.items()}, dt
