"""Measured records: input and output columns, read from a file and checked."""

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...core.conversion import factor
from .columns import Column, Columns, ContentError
from .formats import read_columns
from .units import seconds_of, unit_of

Key = str | int
"""Name of a column, or its number from zero."""

SHORTEST = 50
"""Least number of samples in a record."""

IS_TIME = re.compile(r"time\b|time_|x[-_ ](axis|value)\b", re.IGNORECASE)
"""Pattern of the names of time columns."""

COUNTED = ("s", "ms", "us", "ns", "sequence")
"""Units, in lower case, of columns that count time or samples."""

LONGEST = 100_000_000
"""Most samples of a resampled record."""

LARGEST = 1e100
"""Largest value of a signal; the squares of much larger ones are not finite."""

UNIFORM = 1e-3
"""Largest relative difference of time steps that count as one sample time."""


@dataclass(frozen=True)
class Record:
    """A measured record, uniformly sampled.

    ``inputs`` [samples, m] and ``outputs`` [samples, p] in ``input_units`` and
    ``output_units``, one unit per column. A single column may be given as [samples] and
    its unit as one text. ``dt`` is the sample time in s, ``source`` the origin named in
    messages, ``period`` the number of samples in a period of a periodic input;
    ``input_names`` and ``output_names`` are those of the columns in a file.

    Raises ValueError, naming column and sample, for columns of different length, too
    few samples, missing numbers, a constant column, a sample time that is not positive,
    or a period outside 2..samples.
    """

    inputs: np.ndarray
    outputs: np.ndarray
    dt: float
    input_units: str | tuple[str, ...] = "V"
    output_units: str | tuple[str, ...] = "um"
    source: str = ""
    period: int | None = None
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()

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
                if np.abs(column).max() > LARGEST:
                    raise ValueError(
                        f"{self.source}: {name} reaches {np.abs(column).max():g}; "
                        f"it must stay below {LARGEST:g}"
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
        """The only input [samples]; ValueError if the record has several."""
        return self._only("input", self.inputs)

    @property
    def output(self) -> np.ndarray:
        """The only output [samples]; ValueError if the record has several."""
        return self._only("output", self.outputs)

    def _only(self, side: str, columns: np.ndarray) -> np.ndarray:
        if columns.shape[1] != 1:
            raise ValueError(
                f"{self.source}: the record has {columns.shape[1]} {side}s; "
                "it needs one"
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
        """Range of each output [p], largest minus smallest value."""
        return np.ptp(self.outputs, axis=0)

    @property
    def span(self) -> float:
        """Range of the only output, largest minus smallest value."""
        return float(np.ptp(self.output))

    def in_units(
        self, input_units: Sequence[str], output_units: Sequence[str]
    ) -> "Record":
        """Return the record with its channels converted to these units.

        Raises ValueError, naming the channel, for a unit that cannot be converted, and
        for another number of channels.
        """
        changed: dict[str, Any] = {}
        for side, wanted in (("input", input_units), ("output", output_units)):
            units = getattr(self, f"{side}_units")
            if len(units) != len(wanted):
                raise ValueError(
                    f"{self.source} has {len(units)} {side} columns; {len(wanted)} are "
                    "needed"
                )
            factors = []
            for unit, target in zip(units, wanted, strict=True):
                found = factor(unit, target)
                if found is None:
                    raise ValueError(
                        f"the {side} of {self.source} is in {unit}, and {target} is "
                        "needed: scale the column, and name it with its unit, as "
                        f"{side}_{target}"
                    )
                factors.append(found)
            changed[f"{side}s"] = getattr(self, f"{side}s") * np.array(factors)
            changed[f"{side}_units"] = tuple(wanted)
        return dataclasses.replace(self, **changed)

    def until(self, stop: int) -> "Record":
        """Return the first ``stop`` samples as a record; errors as for Record."""
        return dataclasses.replace(
            self,
            inputs=self.inputs[:stop],
            outputs=self.outputs[:stop],
            period=None,
            source=f"{self.source}, first {stop} samples",
        )

    @property
    def time(self) -> np.ndarray:
        """Sample instants from 0, in s."""
        return np.arange(self.samples) * self.dt


def read_record(
    path: str | Path,
    *,
    time: Key | None = None,
    input: Key | Sequence[Key] = 0,
    output: Key | Sequence[Key] = 1,
    rate: float | None = None,
    period: int | None = None,
    resample: float | None = None,
) -> Record:
    """Read a record from a file in one of ``formats.FORMATS``.

    ``time``, ``input`` and ``output`` are column names or zero-based numbers; several
    inputs or outputs are a sequence of them, or one text with commas. The sample time
    comes from the column ``time``, from ``rate`` (Hz) or from the channel properties in
    the file; if several of these are known, they must agree within 0.1 %. Units come
    from the file or from column names such as ``displacement_um`` or ``drive [V]``.
    ``period`` is that of Record, in samples of the returned record. ``resample`` (Hz)
    interpolates the columns linearly on a uniform grid; time steps may then be uneven.

    Raises ValueError, naming the column and the sample, for a file that cannot be read,
    a missing column, missing numbers, unsorted time, uneven time without ``resample``,
    contradicting sample times, or a record that is too short.
    """
    path = Path(path)
    columns = read_columns(path)
    try:
        clock = _column_names(columns, [] if time is None else [time], "time")
        inputs = _column_names(columns, input, "input")
        outputs = _column_names(columns, output, "output")
        for role, names in (("input", inputs), ("output", outputs)):
            _check_signals(columns, names, role)
        values = _numbers(columns, {"time": clock, "input": inputs, "output": outputs})
        steps = {f"column {n!r}": columns[n].dt for n in inputs + outputs}
        if rate is not None:
            steps = {"the rate": 1.0 / _above_zero(rate, "rate")} | steps
        instants = None
        for name in clock:
            instants = values[name] * seconds_of(name, columns[name])
            step = _time_step(instants, even=resample is None)
            steps = {f"column {name!r}": step} | steps
        dt = _common_step(steps)
        if resample is not None:
            if instants is None:
                instants = dt * np.arange(values[inputs[0]].size)
            values, dt = _resampled(values, instants, resample)
    except ContentError as error:
        raise ValueError(f"{path.name}: {error}") from None
    return Record(
        np.stack([values[name] for name in inputs], axis=1),
        np.stack([values[name] for name in outputs], axis=1),
        dt,
        input_units=tuple(unit_of(n, columns[n]) or "V" for n in inputs),
        output_units=tuple(unit_of(n, columns[n]) or "um" for n in outputs),
        source=path.name,
        period=period,
        input_names=tuple(inputs),
        output_names=tuple(outputs),
    )


def _check_signals(columns: Columns, names: list[str], role: str) -> None:
    for name in names:
        unit = (unit_of(name, columns[name]) or "").lower()
        if IS_TIME.match(name) or unit in COUNTED:
            raise ContentError(
                f"the {role} column is {name!r}; name the columns of input and output: "
                f"there are {', '.join(columns)}"
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


def _time_step(time: np.ndarray, even: bool) -> float:
    """Return the mean step in s of an increasing time axis; check it for ``even``."""
    if time.size < 2:
        raise ContentError(f"{time.size} samples; at least {SHORTEST} are needed")
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
            f"{dt:g} s elsewhere; resample=HZ puts it on a uniform grid"
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
