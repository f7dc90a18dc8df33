"""Units of signals, and the factors between them."""

import re

_IN = {  # factors to the base unit of each quantity
    "V": {"uV": 1e-6, "mV": 1e-3, "V": 1.0, "kV": 1e3},
    "um": {"pm": 1e-6, "nm": 1e-3, "um": 1.0, "mm": 1e3, "m": 1e6},
    "urad": {"nrad": 1e-3, "urad": 1.0, "mrad": 1e3, "rad": 1e6},
}


def factor(unit: str, wanted: str) -> float | None:
    """Return the factor from ``unit`` to ``wanted``, or None, as for nm and V.

    Units of voltage, length and angle are converted; an equal unit has the factor 1.
    """
    if unit == wanted:
        return 1.0
    for known in _IN.values():
        if unit in known and wanted in known:
            return known[unit] / known[wanted]
    return None


def replaced(unit: str, units: dict[str, str]) -> str:
    """Return ``unit`` with the units in it replaced by those of ``units``.

    "V/um" becomes "mV/nm" for ``{"V": "mV", "um": "nm"}``.
    """
    return re.sub("[A-Za-z]+", lambda found: units.get(found[0], found[0]), unit)
