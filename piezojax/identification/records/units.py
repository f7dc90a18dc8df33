"""Units of columns, from the file or from the column names."""

import re

from .columns import Column, ContentError

# Any text in brackets is a unit. After a blank or an underscore only known units count:
# the unit of `drive_raw` is not "raw".
_UNIT = re.compile(
    r"[\[(]\s*([^\])]+?)\s*[\])]\s*$"
    r"|[_\s]([fpnumk]?(?:V|A|m|N|g|s|rad|deg|Hz)|sec|min|h|d|arcsec|counts)$"
)

_SYMBOLS = {
    **dict.fromkeys(("volt", "volts", "v"), "V"),
    **dict.fromkeys(("second", "seconds", "sec", "s"), "s"),
    **dict.fromkeys(("amp", "amps", "ampere", "a"), "A"),
}

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of a time column, in s."""


def unit_of(name: str, column: Column) -> str | None:
    """Return the unit from the file, or from a name as ``drive_V`` or ``drive [V]``."""
    unit = _ascii(column.unit or "").strip(" []()")
    if not unit:
        found = _UNIT.search(_ascii(re.sub(r"\[\d+\]$", "", name)))
        unit = found[1] or found[2] if found else None
    return _SYMBOLS.get(unit.lower(), unit) if unit else None


def _ascii(text: str) -> str:
    return re.sub("[\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}]", "u", text)


def seconds_of(name: str, column: Column) -> float:
    """Return the unit of a time column in s; raise ContentError if it is unknown."""
    unit = unit_of(name, column) or "s"
    if unit not in SECONDS:
        raise ContentError(
            f"time column {name!r} is in {unit!r}, an unknown unit; "
            f"it must be one of {', '.join(SECONDS)}"
        )
    return SECONDS[unit]
