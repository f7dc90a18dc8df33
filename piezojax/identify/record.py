"""A lab's record: time, input, output, read from a file and checked."""

import csv
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SHORTEST = 50
"""Fewest samples a record may have."""

UNIFORM = 1e-3
"""Largest deviation of a time step from their median, as a share of it."""


@dataclass(frozen=True)
class Record:
    """A measured record of one input and one output, uniformly sampled.

    ``input`` and ``output``: arrays of one length, in ``input_unit`` and
    ``output_unit``; ``dt`` in s; ``source``: where it came from.
    """

    input: np.ndarray
    output: np.ndarray
    dt: float
    input_unit: str = "V"
    output_unit: str = "um"
    source: str = ""

    def __post_init__(self):
        if self.input.shape != self.output.shape or self.input.ndim != 1:
            raise ValueError(
                f"{self.source}: input has shape {self.input.shape} and output "
                f"{self.output.shape}; both must be one column of the same length"
            )
        if self.input.size < SHORTEST:
            raise ValueError(
                f"{self.source}: {self.input.size} samples; "
                f"at least {SHORTEST} are needed"
            )
        for name, column in (("input", self.input), ("output", self.output)):
            bad = np.flatnonzero(~np.isfinite(column))
            if bad.size:
                raise ValueError(
                    f"{self.source}: {name} is missing or not finite at sample "
                    f"{bad[0]} ({bad.size} in all)"
                )
            if np.ptp(column) == 0:
                raise ValueError(f"{self.source}: {name} never changes")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(
                f"{self.source}: the sample time is {self.dt:g} s; it must be above 0"
            )

    @property
    def span(self) -> float:
        """Largest less smallest output."""
        return float(np.ptp(self.output))

    @property
    def time(self) -> np.ndarray:
        """Sample instants from 0, s."""
        return np.arange(self.input.size) * self.dt


def read_record(
    path: str | Path,
    *,
    time: str | int | None = None,
    input: str | int = 0,
    output: str | int = 1,
    rate: float | None = None,
) -> Record:
    """Read a record from a ``.csv``, ``.txt``, ``.dat`` or ``.npz`` file.

    ``time``, ``input`` and ``output`` are column names or zero-based numbers; without
    ``time``, ``rate`` (Hz) must be given. Units are taken from names such as
    ``displacement_um``. Raises ValueError, naming the column and the sample, for a
    missing file or column, missing numbers, unsorted or uneven time, or a record that
    is too short.
    """
    path = Path(path)
    columns = _read_columns(path)
    wanted = {"input": input, "output": output}
    if time is not None:
        wanted["time"] = time
    names = {
        role: _named(columns, key, role, path.name) for role, key in wanted.items()
    }
    for role, name in names.items():
        twin = next(other for other, n in names.items() if n == name)
        if twin != role:
            raise ValueError(
                f"{path.name}: column {name!r} is named both as {twin} and as {role}"
            )
    values = {
        role: _numbers(columns[name], f"{role} column {name!r}", path.name)
        for role, name in names.items()
    }
    if len({column.size for column in values.values()}) > 1:
        lengths = ", ".join(f"{names[r]} {c.size}" for r, c in values.items())
        raise ValueError(f"{path.name}: columns differ in length: {lengths}")
    if time is not None:
        seconds = _SECONDS.get(_unit(names["time"]) or "s")
        if seconds is None:
            raise ValueError(
                f"{path.name}: time column {names['time']!r} is in an unknown unit; "
                f"it must be one of {', '.join(_SECONDS)}"
            )
        dt = _time_step(seconds * values["time"], path.name)
    elif rate is not None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"{path.name}: rate is {rate:g} Hz; it must be above 0")
        dt = 1.0 / rate
    else:
        raise ValueError(f"{path.name}: name the time column, or give its rate in Hz")
    return Record(
        values["input"],
        values["output"],
        dt,
        input_unit=_unit(names["input"]) or "V",
        output_unit=_unit(names["output"]) or "um",
        source=path.name,
    )


_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}

_UNIT = re.compile(r"[_\s]+([^\W\d_]+)$|[\[(]\s*([^\])]+?)\s*[\])]\s*$")


def _unit(name: str) -> str | None:
    """Return the unit in ``drive_V``, ``drive [V]`` or ``drive (V)``, if any."""
    found = _UNIT.search(name)
    unit = (found[1] or found[2]) if found else None
    return "um" if unit == "µm" else unit


def _numbers(column: np.ndarray, name: str, source: str) -> np.ndarray:
    """Return ``column`` as finite floats."""
    if column.size != max(column.shape):
        raise ValueError(f"{source}: {name} has shape {column.shape}")
    if not (np.issubdtype(column.dtype, np.floating) or column.dtype.kind in "iub"):
        raise ValueError(f"{source}: {name} is {column.dtype}, not real numbers")
    column = column.astype(float).ravel()
    bad = np.flatnonzero(~np.isfinite(column))
    if bad.size:
        raise ValueError(
            f"{source}: {name} is missing or not finite at sample {bad[0]} "
            f"({bad.size} in all)"
        )
    return column


def _read_columns(path: Path) -> dict[str, np.ndarray]:
    try:
        if path.suffix.lower() == ".npz":
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                return {
                    name: np.asarray(archive[name])
                    for name in archive.files
                    if archive[name].size > 1
                }
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"record {path}: {error.strerror or error}") from None
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        kind = "NPZ archive of plain arrays" if path.suffix == ".npz" else "text file"
        raise ValueError(f"record {path} cannot be read: it is no {kind}") from None
    return _parse_table(text, path)


def _parse_table(text: str, path: Path) -> dict[str, np.ndarray]:
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise ValueError(f"{path.name}: the file is empty")
    delimiter = next((d for d in (",", ";", "\t") if d in lines[0]), None)
    if delimiter:
        rows = [
            [cell.strip() for cell in row]
            for row in csv.reader(lines, delimiter=delimiter)
        ]
    else:
        rows = [line.split() for line in lines]
    # A header is mostly text; one text among numbers is a broken sample.
    numbers = sum(map(_numeric, rows[0]))
    header = rows.pop(0) if 2 * numbers < len(rows[0]) else None
    names = header or [str(i) for i in range(len(rows[0]))]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{path.name}: two columns are called {name!r}")
    table = np.full((len(rows), len(names)), np.nan)
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise ValueError(
                f"{path.name}: sample {i} has {len(row)} columns; "
                f"the first line has {len(names)}"
            )
        for j, cell in enumerate(row):
            try:
                table[i, j] = float(cell) if cell else np.nan
            except ValueError:
                raise ValueError(
                    f"{path.name}: column {names[j]!r}, sample {i}: "
                    f"{cell!r} is no number"
                ) from None
    return dict(zip(names, table.T, strict=True))


def _numeric(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _named(
    columns: dict[str, np.ndarray], key: str | int, role: str, source: str
) -> str:
    """Return the name of the column that ``key`` names or counts."""
    names = list(columns)
    if isinstance(key, int) or (key not in columns and key.isdigit()):
        number = int(key)
        if 0 <= number < len(names):
            return names[number]
    elif key in columns:
        return key
    raise ValueError(
        f"{source}: {role} column {key!r} is missing; there are {', '.join(names)}"
    )


def _time_step(time: np.ndarray, source: str) -> float:
    """Return the step of a uniform time axis, s."""
    if time.size < 2:
        raise ValueError(
            f"{source}: {time.size} samples; at least {SHORTEST} are needed"
        )
    steps = np.diff(time)
    if np.any(steps <= 0):
        sample = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise ValueError(f"{source}: time does not increase at sample {sample}")
    dt = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - dt) > UNIFORM * dt)
    if uneven.size:
        sample = int(uneven[0]) + 1
        raise ValueError(
            f"{source}: time is not uniform: step {steps[sample - 1]:g} s at sample "
            f"{sample}, {dt:g} s elsewhere"
        )
    return float((time[-1] - time[0]) / (time.size - 1))
