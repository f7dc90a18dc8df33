"""A lab's record: time, input, output, read from a file and checked."""

import csv
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
    values = {
        role: _column(columns, key, role, path)
        for role, key in (("input", input), ("output", output))
    }
    if time is not None:
        dt = _time_step(_column(columns, time, "time", path)[1], path)
    elif rate is not None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"{path.name}: rate is {rate:g} Hz; it must be above 0")
        dt = 1.0 / rate
    else:
        raise ValueError(f"{path.name}: name the time column, or give its rate in Hz")
    return Record(
        values["input"][1],
        values["output"][1],
        dt,
        input_unit=_unit(values["input"][0], "V"),
        output_unit=_unit(values["output"][0], "um"),
        source=path.name,
    )


def _unit(name: str, default: str) -> str:
    head, _, tail = name.rpartition("_")
    return tail if head and tail.isalpha() else default


def _read_columns(path: Path) -> dict[str, np.ndarray]:
    try:
        if path.suffix.lower() == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                return {
                    name: np.asarray(archive[name], float).ravel() for name in archive
                }
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"record {path}: {error.strerror}") from None
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"record {path} cannot be read: {error}") from None
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
    header = None if _numeric(rows[0]) else rows.pop(0)
    names = header or [str(i) for i in range(len(rows[0]) if rows else 0)]
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


def _numeric(cells: list[str]) -> bool:
    try:
        [float(cell) for cell in cells if cell]
    except ValueError:
        return False
    return True


def _column(
    columns: dict[str, np.ndarray], key: str | int, role: str, path: Path
) -> tuple[str, np.ndarray]:
    names = list(columns)
    if isinstance(key, int) or (key not in columns and key.isdigit()):
        number = int(key)
        if number < len(names):
            return names[number], columns[names[number]]
    elif key in columns:
        return key, columns[key]
    raise ValueError(
        f"{path.name}: {role} column {key!r} is missing; there are {', '.join(names)}"
    )


def _time_step(time: np.ndarray, path: Path) -> float:
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise ValueError(f"{path.name}: time is missing at sample {bad[0]}")
    if time.size < 2:
        raise ValueError(
            f"{path.name}: {time.size} samples; at least {SHORTEST} are needed"
        )
    steps = np.diff(time)
    if np.any(steps <= 0):
        sample = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise ValueError(f"{path.name}: time does not increase at sample {sample}")
    dt = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - dt) > UNIFORM * dt)
    if uneven.size:
        sample = int(uneven[0]) + 1
        raise ValueError(
            f"{path.name}: time is not uniform: step {steps[sample - 1]:g} s at sample "
            f"{sample}, {dt:g} s elsewhere"
        )
    return float((time[-1] - time[0]) / (time.size - 1))
