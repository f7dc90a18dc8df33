"""Units of signals, and the factors between them."""

import re

_IN = {
    "V": {"uV": 1e-6, "mV": 1e-3, "V": 1.0, "kV": 1e3},
    "um": {"pm": 1e-6, "nm": 1e-3, "um": 1.0, "mm": 1e3, "m": 1e6},
    "urad": {"nrad": 1e-3, "urad": 1.0, "mrad": 1e3, "rad": 1e6},
}


def factor(unit: str, wanted: str) -> float | None:
    """Return the factor from ``unit`` to ``wanted`` (V, um or urad).

    None if there is none, as from nm to V.
    """
    return 1.0 if unit == wanted else _IN.get(wanted, {}).get(unit)


def replaced(unit: str, units: dict[str, str]) -> str:
    """Return ``unit`` with the units in it replaced by those of ``units``.

    "V/um" becomes "mV/nm" for ``{"V": "mV", "um": "nm"}``.
    """
    return re.sub("[A-Za-z]+", lambda found: units.get(found[0], found[0]), unit)
