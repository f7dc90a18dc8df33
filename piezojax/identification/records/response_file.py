"""Frequency responses from files of an analyser: magnitude and phase, or complex."""

import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from .columns import Column, Columns
from .formats import read_columns
from .response import FrequencyResponse
from .saved_response import stated_in
from .touchstone import SUFFIXES, touchstone
from .units import unit_of

_FREQUENCY = re.compile(
    r"(?<![a-z])([a-z]?)(hz|rad[/ ](s|sec|second|timeunit)\b)", re.I
)
"""Unit of a frequency in its name or unit: a prefix, and Hz or rad/s."""

_PREFIXES = {"": 1.0, "m": 1e-3, "k": 1e3, "K": 1e3, "M": 1e6, "G": 1e9}
"""Factors of the prefixes."""

_RADIAN = 0.5 / np.pi
"""Factor from rad/s to Hz."""

_ROLES = {
    "coherence": r"coh",
    "noise": r"^noise deviation\b",
    "other": r"^distortion deviation\b",
    "variance": r"^deviation\b",
    "real": r"\bre(al)?\b",
    "imaginary": r"\bim(ag|aginary)?\b",
    "phase": r"phase|\barg\b|angle",
    "magnitude": r"mag|gain|ampl|db|\babs\b|ratio",
    "frequency": r"freq|omega|^f\b|\bk?hz\b|rad/s",
}
"""Text in the name or unit of a column that gives its role, the first that matches."""

_OF_ONE = ("coherence", "noise", "variance")
"""Roles of columns that are read if the file holds a single response."""

UNIT = "um/V"
"""Unit of a response whose file does not state it."""


def read_response(path: str | Path, *, unit: str | None = None) -> FrequencyResponse:
    """Read the only frequency response in a file; arguments as ``read_responses``.

    Raises ValueError as ``read_responses``, and for a file with several responses.
    """
    found = read_responses(path, unit=unit)
    if len(found) > 1:
        raise ValueError(f"{path}: there are {len(found)} responses in it; keep one")
    return found[0]


def read_responses(
    path: str | Path, *, unit: str | None = None
) -> list[FrequencyResponse]:
    """Read frequency responses from a table in one of ``formats.FORMATS``.

    The names and units of the columns give their roles: a frequency (Hz or rad/s, with
    or without a prefix as in kHz),
    and magnitude (a ratio, or dB re 1 unit of the response) with phase (degrees or
    radians), or real and imaginary part, or complex numbers, as the variables
    ``ResponseData``, ``Frequency`` and ``FrequencyUnit`` of a MATLAB file. A frequency
    without a unit is in Hz, an omega in rad/s. With several columns of one role, each
    pair of columns is a response; they are paired by the number in their names, or else
    by their order. Columns ``deviation``, ``noise_deviation`` (standard deviations) and
    ``coherence`` are read if the file holds a single response. Other columns are
    ignored. The lines are sorted; one at 0 Hz is left out.

    A Touchstone file is read too: S11 of one port, S21 of two. ``unit`` is that of the
    response, if its columns do not state it; by default UNIT.

    Raises ValueError, listing the columns, for a file without these columns or with
    columns that do not belong together, for a frequency in another unit, for a phase
    whose unit is not in its name,
    columns of different length, a magnitude below 0, two units, and as
    FrequencyResponse.
    """
    path = Path(path)
    if path.suffix.lower() in SUFFIXES:
        frequency, values = touchstone(path)
        return [_sorted(frequency, values, unit or UNIT, str(path))]
    columns = read_columns(path)
    roles = _roles(columns)
    sizes = {
        name: columns[name].values.size for names in roles.values() for name in names
    }
    if len(set(sizes.values())) > 1:
        shown = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise ValueError(f"{path}: the columns differ in length: {shown}")
    frequency = _frequency(columns, roles, path)
    pairs = _pairs(columns, roles, path)
    found = []
    for names in pairs:
        own = _unit(columns, names, unit, path)
        values = _values(columns, names, path)
        source = f"{path}: {names[0]}" if len(pairs) > 1 else str(path)
        more = {} if len(pairs) > 1 else _more(columns, roles, path)
        found.append(_sorted(frequency, values, own, source, **more))
    return found


def _sorted(
    frequency: np.ndarray, values: np.ndarray, unit: str, source: str, **more
) -> FrequencyResponse:
    order = np.argsort(frequency, kind="stable")
    order = order[frequency[order] != 0.0]
    lined: dict[str, Any] = {
        name: part[order] if isinstance(part, np.ndarray) else part
        for name, part in more.items()
    }
    return FrequencyResponse(frequency[order], values[order], unit, source, **lined)


def _label(name: str, column: Column) -> str:
    return f"{name} {column.unit or ''}".lower().replace("_", " ").strip()


def _roles(columns: Columns) -> dict[str, list[str]]:
    """Return the columns of each role."""
    found: dict[str, list[str]] = defaultdict(list)
    for name, column in columns.items():
        label = _label(name, column)
        role = next((r for r, text in _ROLES.items() if re.search(text, label)), None)
        if np.iscomplexobj(column.values) and role != "frequency":
            role = "complex"
        if role is not None and role != "other":
            found[role].append(name)
    return found


def _frequency(columns: Columns, roles: dict[str, list[str]], path: Path) -> np.ndarray:
    """Return the frequencies in Hz."""
    names = roles.get("frequency", [])
    if len(names) > 1:
        raise ValueError(
            f"{path}: {names[0]!r} and {names[1]!r} are both a frequency; keep one"
        )
    if not names:
        raise ValueError(
            f"{path}: no column is a frequency; name one frequency_Hz (there are "
            f"{', '.join(columns)}), or give the --method for a record over time"
        )
    name, column = names[0], columns[names[0]]
    return _hertz(name, column, columns, path) * _numbers(columns, name, path)


def _hertz(name: str, column: Column, columns: Columns, path: Path) -> float:
    """Return the unit of the frequency column ``name`` in Hz."""
    text = f"{name} {column.unit or ''}".replace("_", " ")
    found = _FREQUENCY.search(re.sub("(?i)frequency|freq|omega", " ", text))
    if found is not None:
        prefix, unit = found[1], found[2]
        # The case tells mega from milli; in "mhz" it does not.
        if prefix not in _PREFIXES or (prefix, unit) == ("m", "hz"):
            raise ValueError(
                f"{path}: column {name!r} is in {found[0]}, an unknown unit of a "
                "frequency; scale it to Hz, and name it frequency_Hz"
            )
        return _PREFIXES[prefix] * (1.0 if unit.lower() == "hz" else _RADIAN)
    stated = re.search(r"[\[(](.*?)[\])]", name)
    if unit := column.unit or (stated and stated[1]):
        raise ValueError(
            f"{path}: column {name!r} is in {unit}, an unknown unit of a frequency; "
            "scale it to Hz, and name it frequency_Hz"
        )
    if name == "Frequency" and "ResponseData" in columns:
        raise ValueError(
            f"{path}: the unit of Frequency is not known (MATLAB's default is "
            "rad/s): add a variable FrequencyUnit, 'Hz' or 'rad/s'"
        )
    return _RADIAN if "omega" in text.lower() else 1.0


def _pairs(
    columns: Columns, roles: dict[str, list[str]], path: Path
) -> list[tuple[str, ...]]:
    """Return the columns of each response."""
    if "complex" in roles:
        return [(name,) for name in roles["complex"]]
    for two in (("real", "imaginary"), ("magnitude", "phase")):
        if not all(role in roles for role in two):
            continue
        first, second = (roles[role] for role in two)
        if len(first) != len(second):
            role = two[0] if len(first) > len(second) else two[1]
            names = roles[role]
            raise ValueError(
                f"{path}: {names[0]!r} and {names[1]!r} are both a {role}; keep one, "
                "or give each its own partner"
            )
        numbers = [
            [re.findall(r"\d+", name)[:1] for name in each] for each in (first, second)
        ]
        if all(map(all, numbers)) and sorted(numbers[0]) == sorted(numbers[1]):
            second = [second[numbers[1].index(number)] for number in numbers[0]]
        return list(zip(first, second, strict=True))
    raise ValueError(
        f"{path}: name the columns of the response magnitude_dB or magnitude, and "
        f"phase_deg or phase_rad, or real and imag (there are {', '.join(columns)})"
    )


def _unit(
    columns: Columns, names: tuple[str, ...], unit: str | None, path: Path
) -> str:
    """Return the unit of a response, from its columns or as given."""
    stated = unit_of(names[0], columns[names[0]]) or ""
    if "/" not in stated:
        return unit or UNIT
    if unit not in (None, stated):
        raise ValueError(
            f"{path}: column {names[0]!r} is in {stated}, and the unit given is {unit}"
        )
    return stated


def _values(columns: Columns, names: tuple[str, ...], path: Path) -> np.ndarray:
    """Return the complex values in the columns ``names``."""
    if len(names) == 1:
        return columns[names[0]].values
    first = _label(names[0], columns[names[0]])
    if re.search(_ROLES["real"], first):
        parts = (_numbers(columns, name, path) for name in names)
        return np.array([1.0, 1j]) @ np.array([*parts])
    return _magnitude(columns, names[0], path) * np.exp(
        1j * _phase(columns, names[1], path)
    )


def _more(
    columns: Columns, roles: dict[str, list[str]], path: Path
) -> dict[str, object]:
    """Return the other properties of the only response of a file."""
    found: dict[str, object] = {}
    for role in _OF_ONE:
        names = roles.get(role, [])
        if len(names) == 1:
            values = _numbers(columns, names[0], path)
            found[role] = values if role == "coherence" else values**2
    return found | stated_in(path)


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
