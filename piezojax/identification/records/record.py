"""Measured records: input and output columns, read from a file and checked."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...core.conversion import factor
from .sampled import Key, Sampled, read_sampled

EXCITATIONS = ("reference", "dither")
"""Signals that excite a closed loop, fields of a record."""

SHORTEST = 50
"""Least number of samples in a record."""

EVEN = 1e-3
"""Largest scatter of the steps of a time axis, as a share of their mean."""

LARGEST = 1e100
"""Largest value of a signal; the squares of much larger ones are not finite."""


@dataclass(frozen=True)
class Record:
    """A measured record, uniformly sampled.

    ``inputs`` [samples, m] and ``outputs`` [samples, p] in ``input_units`` and
    ``output_units``, one unit per column. A single column may be given as [samples] and
    its unit as one text. ``dt`` is the sample time in s, ``source`` the origin named in
    messages, ``period`` the number of samples in a period of a periodic input;
    ``input_names`` and ``output_names`` are those of the columns in a file, ``assumed``
    those whose unit neither the file nor their name states: they are taken to be in V
    and um. ``clock`` is the time column if its unit is not stated; it is taken as s.

    A record of a closed loop may hold its excitation: the ``reference`` [samples] in
    the unit of the output, and the ``dither`` [samples] in that of the input, which is
    added to the command of the controller and contained in the input.

    Raises ValueError, naming column and sample, for columns of different length, too
    few samples, missing numbers, a constant input or output, a sample time that is not
    positive, a period outside 2..samples, or a reference or dither beside several
    inputs or outputs.
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
    assumed: tuple[str, ...] = ()
    clock: str = ""
    reference: np.ndarray | None = None
    dither: np.ndarray | None = None

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
        self._check_excitation()
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(
                f"{self.source}: the sample time is {self.dt:g} s; it must be above 0"
            )
        if self.period is not None and not 1 < self.period <= samples:
            raise ValueError(
                f"{self.source}: the period is {self.period} samples; "
                f"it must lie in 2..{samples}"
            )

    def _check_excitation(self) -> None:
        """Check reference and dither, and store them as floats."""
        for name in EXCITATIONS:
            if getattr(self, name) is None:
                continue
            signal = np.asarray(getattr(self, name), dtype=float)
            object.__setattr__(self, name, signal)
            if signal.shape != (self.samples,):
                raise ValueError(
                    f"{self.source}: {name} has shape {signal.shape}; it must be "
                    f"[samples], here ({self.samples},)"
                )
            if not self.single:
                raise ValueError(
                    f"{self.source}: a record with a {name} must have one input and "
                    "one output"
                )
            bad = np.flatnonzero(~(np.abs(signal) <= LARGEST))
            if bad.size:
                raise ValueError(
                    f"{self.source}: {name} is missing or not finite at sample "
                    f"{bad[0]} ({bad.size} in all)"
                )

    @property
    def single(self) -> bool:
        """Whether the record has one input and one output."""
        return self.inputs.shape[1] == self.outputs.shape[1] == 1

    @property
    def closed_loop(self) -> bool:
        """Whether the record holds the reference or the dither of a loop."""
        return self.reference is not None or self.dither is not None

    @property
    def excitation(self) -> np.ndarray:
        """Reference and dither [samples, 0 to 2], those that change."""
        known = [getattr(self, name) for name in EXCITATIONS]
        moving = [each for each in known if each is not None and np.ptp(each) > 0.0]
        return np.stack(moving, axis=1) if moving else np.empty((self.samples, 0))

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

    @property
    def slews(self) -> np.ndarray:
        """Largest change of each input [m] between two samples, in its unit per s."""
        return np.abs(np.diff(self.inputs, axis=0)).max(axis=0) / self.dt

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
            beside = "dither" if side == "input" else "reference"
            if getattr(self, beside) is not None:
                changed[beside] = getattr(self, beside) * factors[0]
        return dataclasses.replace(self, **changed)

    def until(self, stop: int) -> "Record":
        """Return the first ``stop`` samples as a record; errors as for Record."""
        source = f"{self.source}, first {stop} samples"
        return dataclasses.replace(self, period=None).during(slice(stop), source)

    def during(self, part: slice, source: str | None = None) -> "Record":
        """Return the samples ``part`` as a record; errors as for Record."""
        kept = {
            name: None if signal is None else signal[part]
            for name in EXCITATIONS
            for signal in [getattr(self, name)]
        }
        return dataclasses.replace(
            self,
            inputs=self.inputs[part],
            outputs=self.outputs[part],
            source=source or self.source,
            **kept,
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
    reference: Key | None = None,
    dither: Key | None = None,
    rate: float | None = None,
    period: int | None = None,
    resample: float | None = None,
) -> Record:
    """Read a record from a file in one of ``formats.FORMATS``.

    ``time``, ``input`` and ``output`` are column names or zero-based numbers; several
    inputs or outputs are a sequence of them, or one text with commas. ``reference`` and
    ``dither`` are the columns that excite a closed loop, converted to the units of
    output and input; a reference or dither without a unit is in these. The sample time
    comes from the column ``time``, from ``rate`` (Hz) or from the channel properties in
    the file; if several of these are known, they must agree within 0.1 %. Units come
    from the file or from column names such as ``displacement_um`` or ``drive [V]``.
    ``period`` is that of Record, in samples of the returned record. ``resample`` (Hz)
    interpolates the columns linearly on a uniform grid; time steps may then be uneven.

    Raises ValueError, naming the column and the sample, for a file that cannot be read,
    a missing column, missing numbers, unsorted time, uneven time without ``resample``,
    contradictory sample times, a reference or dither in a unit that cannot be
    converted, a record that is too short, or, without ``time``, a column given by its
    number that rises in even steps, as a time axis does.
    """
    path = Path(path)
    roles: dict[str, Key | Sequence[Key]] = {"input": input, "output": output}
    exciting = zip(EXCITATIONS, (reference, dither), strict=True)
    roles |= {role: key for role, key in exciting if key is not None}
    even = resample is None
    read = read_sampled(path, roles, time=time, rate=rate, even=even, least=SHORTEST)
    if resample is not None:
        read = read.resampled(resample, path)
    inputs, outputs = read.names["input"], read.names["output"]
    if time is None:
        _refuse_time_axes(read, roles, path)
    return Record(
        read.matrix("input"),
        read.matrix("output"),
        read.dt,
        input_units=tuple(read.units[n] or "V" for n in inputs),
        output_units=tuple(read.units[n] or "um" for n in outputs),
        source=path.name,
        period=period,
        input_names=tuple(inputs),
        output_names=tuple(outputs),
        assumed=tuple(n for n in (*inputs, *outputs) if read.units[n] is None),
        clock=read.clock,
        **{
            role: _converted(read, role, of[0], path)
            for role, of in (("reference", outputs), ("dither", inputs))
            if role in roles
        },
    )


def _converted(read: Sampled, role: str, beside: str, path: Path) -> np.ndarray:
    """Return the only column of ``role``, [samples], in the unit of ``beside``."""
    (name,) = read.names[role]
    unit, wanted = read.units[name], read.units[beside]
    if unit is None or wanted is None:
        return read.values[name]
    found = factor(unit, wanted)
    if found is None:
        raise ValueError(
            f"{path.name}: the {role} column {name!r} is in {unit}, and {wanted} is "
            f"needed, the unit of {beside!r}: scale the column, and name it with its "
            "unit"
        )
    return read.values[name] * found


def _refuse_time_axes(
    read: Sampled, roles: Mapping[str, Key | Sequence[Key]], path: Path
) -> None:
    """Raise ValueError if a column given by its number seems to be the time.

    A column given by its name is accepted; ``identify`` warns about it.
    """
    for role, given in roles.items():
        names = read.names[role]
        keys: Iterable[Any] = [given]
        if len(names) > 1:
            keys = given.split(",") if isinstance(given, str) else np.atleast_1d(given)
        for key, name in zip(keys, names, strict=True):
            column = read.values[name]
            if rises_evenly(column) and str(key).strip().isdecimal():
                raise ValueError(
                    f"{path.name}: column {key} ({name!r}), taken as the {role}, rises "
                    f"in even steps of {np.mean(np.diff(column)):.4g}, as a time axis "
                    "does: name the columns of time, input and output"
                )


def rises_evenly(column: np.ndarray) -> bool:
    """Return whether ``column`` rises in even steps, as a time axis does."""
    steps = np.diff(column)
    if steps.size < 2 or np.any(steps <= 0.0):
        return False
    return bool(np.std(steps) < EVEN * np.mean(steps))
