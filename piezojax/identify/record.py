"""A lab's record: time, input, output, read from a file and checked."""

import csv
import dataclasses
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
    """A measured record, uniformly sampled.

    ``inputs`` [samples, m] and ``outputs`` [samples, p] in ``input_units`` and
    ``output_units``, one name a column; a single column may be given as [samples] and
    its unit as one name. ``dt`` in s; ``source``: where it came from; ``period``: the
    samples of one period where the input repeats itself. Raises ValueError, naming
    column and sample, for columns of different length, too few samples, numbers that
    are missing, a column that never changes, or a sample time that is not positive.
    """

    inputs: np.ndarray
    outputs: np.ndarray
    dt: float
    input_units: str | tuple[str, ...] = "V"
    output_units: str | tuple[str, ...] = "um"
    source: str = ""
    period: int | None = None

    def __post_init__(self):
        for side in ("input", "output"):
            columns = np.asarray(getattr(self, side + "s"), dtype=float)
            if columns.ndim == 1:
                columns = columns[:, None]
            if columns.ndim != 2:
                raise ValueError(
                    f"{self.source}: {side} has shape {columns.shape}; "
                    "it must be [samples] or [samples, channels]"
                )
            units = getattr(self, side + "_units")
            units = (units,) * columns.shape[1] if isinstance(units, str) else units
            if len(units) != columns.shape[1]:
                raise ValueError(
                    f"{self.source}: {len(units)} units for {columns.shape[1]} "
                    f"{side} columns"
                )
            object.__setattr__(self, side + "s", columns)
            object.__setattr__(self, side + "_units", tuple(units))
        samples = len(self.inputs)
        if len(self.outputs) != samples:
            raise ValueError(
                f"{self.source}: input has {samples} samples and output "
                f"{len(self.outputs)}; they must be of the same length"
            )
        if samples < SHORTEST:
            raise ValueError(
                f"{self.source}: {samples} samples; at least {SHORTEST} are needed"
            )
        for side, columns in (("input", self.inputs), ("output", self.outputs)):
            for i, column in enumerate(columns.T):
                name = side if columns.shape[1] == 1 else f"{side} {i}"
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
        if self.period is not None and not 1 < self.period <= samples:
            raise ValueError(
                f"{self.source}: the period is {self.period} samples; "
                f"it must lie in 2..{samples}"
            )

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.inputs)

    @property
    def input(self) -> np.ndarray:
        """The input [samples] of a record with one; ValueError if it has several."""
        return self._only("input", self.inputs)

    @property
    def output(self) -> np.ndarray:
        """The output [samples] of a record with one; ValueError if it has several."""
        return self._only("output", self.outputs)

    def _only(self, side: str, columns: np.ndarray) -> np.ndarray:
        if columns.shape[1] != 1:
            raise ValueError(
                f"{self.source}: the record has {columns.shape[1]} {side}s; "
                "this needs one"
            )
        return columns[:, 0]

    @property
    def input_unit(self) -> str:
        """Unit of the first input."""
        return self.input_units[0]

    @property
    def output_unit(self) -> str:
        """Unit of the first output."""
        return self.output_units[0]

    @property
    def spans(self) -> np.ndarray:
        """Largest less smallest of each output [p]."""
        return np.ptp(self.outputs, axis=0)

    @property
    def span(self) -> float:
        """Largest less smallest of the only output."""
        return float(np.ptp(self.output))

    def until(self, stop: int) -> "Record":
        """Return the record of the first ``stop`` samples; ValueError as the record."""
        return dataclasses.replace(
            self,
            inputs=self.inputs[:stop],
            outputs=self.outputs[:stop],
            period=None,
            source=f"{self.source}, first {stop} samples",
        )

    @property
    def time(self) -> np.ndarray:
        """Sample instants from 0, s."""
        return np.arange(self.samples) * self.dt


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
        input_units=_unit(names["input"]) or "V",
        output_units=_unit(names["output"]) or "um",
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
