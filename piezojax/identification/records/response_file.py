"""Frequency responses from files of an analyser: magnitude and phase, or complex."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .columns import Column, Columns
from .formats import read_columns

LEAST_LINES = 8

_HERTZ = {"khz": 1e3, "hz": 1.0, "rad/s": 0.5 / np.pi, "omega": 0.5 / np.pi}
"""Factors to Hz by text in the name or unit; the first that matches, else 1."""

_ROLES = {
    "coherence": r"coh",
    "real": r"\bre(al)?\b",
    "imaginary": r"\bim(ag|aginary)?\b",
    "phase": r"phase|\barg\b|angle",
    "magnitude": r"mag|gain|ampl|db|\babs\b|ratio",
    "frequency": r"freq|omega|^f\b|\bk?hz\b|rad/s",
}
"""Text in the name or unit of a column that gives its role, the first that matches."""


@dataclass(frozen=True)
class FrequencyResponse:
    """Measured frequency response of one input and one output.

    ``frequency`` [lines] in Hz increases; ``values`` [lines] are complex, in ``unit``
    (output over input). Raises ValueError for fewer than LEAST_LINES lines, columns of
    different length, numbers that are not finite, and frequencies that are not above 0
    or do not increase.
    """

    frequency: np.ndarray
    values: np.ndarray
    unit: str = "um/V"
    source: str = ""

    def __post_init__(self):
        frequency = np.asarray(self.frequency, float)
        values = np.asarray(self.values, complex)
        object.__setattr__(self, "frequency", frequency)
        object.__setattr__(self, "values", values)
        where = f"{self.source}: " if self.source else ""
        if frequency.ndim != 1 or frequency.shape != values.shape:
            raise ValueError(
                f"{where}frequency has the shape {frequency.shape}, the response "
                f"{values.shape}; both must be [lines]"
            )
        if frequency.size < LEAST_LINES:
            raise ValueError(
                f"{where}the response has {frequency.size} lines; at least "
                f"{LEAST_LINES} are needed"
            )
        if not (np.all(np.isfinite(frequency)) and np.all(np.isfinite(values))):
            line = int(np.argmin(np.isfinite(frequency) & np.isfinite(values)))
            raise ValueError(f"{where}line {line} is not a finite number")
        if frequency[0] <= 0.0 or np.any(np.diff(frequency) <= 0.0):
            raise ValueError(
                f"{where}the frequencies must be above 0 and increase from line to line"
            )


def read_response(path: str | Path, *, unit: str = "um/V") -> FrequencyResponse:
    """Read a frequency response from a table in one of ``formats.FORMATS``.

    The names and units of the columns give their roles: a frequency (Hz, kHz or rad/s),
    and magnitude (a ratio, or dB re 1 ``unit``) with phase (degrees or radians), or
    real and imaginary part. A frequency without a unit is in Hz, an omega in rad/s.
    Other columns are ignored. The lines are sorted; one at 0 Hz is left out.

    Raises ValueError, listing the columns, for a file without these columns or with two
    of one role, for a phase whose unit is not in its name, columns of different length,
    a magnitude below 0, and as FrequencyResponse.
    """
    path = Path(path)
    columns = read_columns(path)
    roles = _roles(columns, path)
    sizes = {name: columns[name].values.size for name in roles.values()}
    if len(set(sizes.values())) > 1:
        shown = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise ValueError(f"{path}: the columns differ in length: {shown}")
    listed = ", ".join(columns)
    if "frequency" not in roles:
        raise ValueError(
            f"{path}: no column is a frequency; name one frequency_Hz (there are "
            f"{listed})"
        )
    frequency = _numbers(columns, roles["frequency"], path)
    text = _label(roles["frequency"], columns[roles["frequency"]])
    frequency = frequency * next((s for n, s in _HERTZ.items() if n in text), 1.0)
    if {"real", "imaginary"} <= roles.keys():
        parts = (_numbers(columns, roles[role], path) for role in ("real", "imaginary"))
        values = np.array([1.0, 1j]) @ np.array([*parts])
    elif {"magnitude", "phase"} <= roles.keys():
        values = _magnitude(columns, roles["magnitude"], path) * np.exp(
            1j * _phase(columns, roles["phase"], path)
        )
    else:
        raise ValueError(
            f"{path}: name the columns of the response magnitude_dB or magnitude, and "
            f"phase_deg or phase_rad, or real and imag (there are {listed})"
        )
    order = np.argsort(frequency, kind="stable")
    order = order[frequency[order] != 0.0]
    return FrequencyResponse(frequency[order], values[order], unit, str(path))


def _label(name: str, column: Column) -> str:
    return f"{name} {column.unit or ''}".lower().replace("_", " ").strip()


def _roles(columns: Columns, path: Path) -> dict[str, str]:
    """Return the column of each role."""
    found: dict[str, str] = {}
    for name, column in columns.items():
        label = _label(name, column)
        role = next((r for r, text in _ROLES.items() if re.search(text, label)), None)
        if role is None or role == "coherence":
            continue
        if role in found:
            raise ValueError(
                f"{path}: {found[role]!r} and {name!r} are both a {role}; keep one"
            )
        found[role] = name
    return found


def _numbers(columns: Columns, name: str, path: Path) -> np.ndarray:
    column = columns[name]
    if column.fault:
        raise ValueError(f"{path}: column {name!r}: {column.fault}")
    return np.asarray(column.values, float)


def _magnitude(columns: Columns, name: str, path: Path) -> np.ndarray:
    values = _numbers(columns, name, path)
    if "db" in _label(name, columns[name]):
        return 10.0 ** (values / 20.0)
    if np.any(values < 0.0):
        raise ValueError(
            f"{path}: column {name!r} is below 0; name it {name}_dB if it is in dB"
        )
    return values


def _phase(columns: Columns, name: str, path: Path) -> np.ndarray:
    """Return the phase in radians."""
    values, label = _numbers(columns, name, path), _label(name, columns[name])
    if re.search(r"\bdeg(rees?)?\b|°", label):
        return np.deg2rad(values)
    if re.search(r"\brad\b", label):
        return values
    raise ValueError(
        f"{path}: the unit of column {name!r} is not known; name it {name}_deg or "
        f"{name}_rad"
    )
