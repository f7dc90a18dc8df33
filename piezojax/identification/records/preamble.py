"""Lines above a table of samples: names, units, and the settings of an oscilloscope.

Rigol, Keysight, Tektronix and LeCroy write one setting per line, or in the line of the
units, or beside the first samples. The settings are found by their names.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

Row = Sequence[str]
Numeric = Callable[[str], bool]

_STEP = re.compile(
    r"(sampl(e|ing) (interval|period|time)|x?inc(rement)?|tinc|delta x|dt)$"
)
_RATE = re.compile(r"(sampl(e|ing) (rate|frequency)|fs)$")
_START = re.compile(r"(start|t0)$")
_SCALE = re.compile(r"(vertical scale|v(olts)?/div|ymult|yincrement)$")
_NUMBER = re.compile(
    r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([munk]?)(s|hz|sa?/s)?$", re.I
)
_PREFIX = {"": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9, "k": 1e3}
_UNITS = re.compile(
    r"\W*(sequence|s(ec(ond)?s?)?|[munk]?(v(olts?)?|a(mp(ere)?s?)?|s|m|rad|hz))\W*$",
    re.I,
)


class Head(NamedTuple):
    """Names and units of columns, sample time (s), and whether a scale is given."""

    names: list[str] | None = None
    units: list[str] | None = None
    dt: float | None = None
    scaled: bool = False


def split(
    rows: list[Row], numeric: Numeric, mostly_text: Callable[[Row], bool]
) -> tuple[Head, list[Row]]:
    """Return the Head of a table and its rows of samples."""
    settings, rows = _beside(rows, numeric)
    if settings:
        source = _cells(settings, "source")[:1]
        single = source and len(_trimmed(rows[0])) == 2
        return _head(["time", *source] if single else None, None, settings), rows
    count = _head_rows(rows, numeric, mostly_text)
    above, rows = rows[:count], rows[count:]
    if not above:
        return Head(), rows
    columns = len(_trimmed(rows[0])) if rows else 0
    full = [len([cell for cell in row if cell]) >= columns for row in above]
    if count == 1 or (count == 2 and not full[1]):
        return _head(list(above[0]), None, (), columns), [*above[1:], *rows]
    units = all(map(_UNITS.match, above[-1]))
    if (count == 2 and (full[0] or units)) or (full[-1] and full[-2] and units):
        return _head(list(above[-2]), list(above[-1]), above[:-2], columns), rows
    if full[-1]:
        return _head(list(above[-1]), None, above[:-1], columns), rows
    return _head(None, None, above), rows


def _beside(rows: list[Row], numeric: Numeric) -> tuple[list[Row], list[Row]]:
    """Return the settings in columns left of the samples, and the samples.

    The columns are empty below the settings.
    """
    last = next((i for i, cell in enumerate(rows[-1]) if cell), 0)
    first = rows[0]
    if last < 2 or numeric(first[0]) or not first[0] or not numeric(first[1]):
        return [], rows
    return [row[:last] for row in rows if row[0]], [row[last:] for row in rows]


def _head_rows(
    rows: Sequence[Row], numeric: Numeric, mostly_text: Callable[[Row], bool]
) -> int:
    """Return the number of rows above the samples."""
    numbered = numeric(rows[-1][0])
    count = 0
    for i, row in enumerate(rows):
        if mostly_text(row):
            count = i + 1
        elif not numbered or numeric(row[0]):
            break
        if i == 1 and not numbered:
            break  # samples of text: at most names and units stand above them
    return count


def _head(
    names: list[str] | None,
    units: list[str] | None,
    settings: Sequence[Row],
    columns: int = 0,
) -> Head:
    """Return the Head; settings may also stand behind the names and units."""
    pairs = [(_word(cell), value) for row in settings for cell, value in pairwise(row)]
    while names and len(names) > columns > 0 and _is_setting(names[-1]):
        name, _, value = names.pop().partition("=")
        if units is not None and len(units) > len(names):
            value = value or units[len(names)]
        pairs.append((_word(name), value))
    if names is not None:
        units = units or [
            *_cells(settings, "horizontal units")[:1],
            *_cells(settings, "vertical units"),
        ]
        units = [*units[: len(names)], *[""] * (len(names) - len(units))]
    steps = [_si(value) for word, value in pairs if _STEP.match(word)]
    rates = [_si(value) for word, value in pairs if _RATE.match(word)]
    known = [step for step in steps if step] + [1.0 / rate for rate in rates if rate]
    scaled = any(_SCALE.match(word) for word, _ in pairs)
    return Head(names, units, known[0] if known else None, scaled)


def _is_setting(name: str) -> bool:
    word = _word(name.partition("=")[0])
    return not word or bool(_STEP.match(word) or _START.match(word))


def _word(cell: str) -> str:
    """Return a setting in lower case, without its unit, colon and underscores."""
    return re.sub(r"[_:\s]+|[(\[].*$", " ", cell).strip().lower()


def _cells(rows: Iterable[Row], setting: str) -> list[str]:
    """Return the cells behind the first cell that is ``setting``."""
    for row in rows:
        if _word(row[0]) == setting:
            return [cell for cell in row[1:] if cell]
    return []


def _trimmed(row: Row) -> Row:
    width = max((i + 1 for i, cell in enumerate(row) if cell), default=0)
    return row[:width]


def _si(cell: str) -> float | None:
    """Return a positive number with an optional unit in s or Hz; None for others."""
    found = _NUMBER.match(cell.strip())
    try:
        value = float(found[1]) * _PREFIX[found[2].lower()] if found else 0.0
    except ValueError:
        return None
    return value if 0.0 < value < float("inf") else None
