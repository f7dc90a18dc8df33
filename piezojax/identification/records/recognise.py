"""Columns of a record by their units, and the noise of its sensor."""

from math import comb
from pathlib import Path
from typing import Any

import numpy as np

from ...core.conversion import factor
from .columns import Column, Columns
from .formats import read_columns
from .record import Record
from .sampled import is_clock, response_hint
from .units import SECONDS, seconds_of, unit_of

_QUANTITIES = {"input": "V", "output": "um"}
"""Unit of each role; a column in a convertible unit qualifies as well."""

CONTRADICTED = 0.01
"""Relative difference of two rates above which one of them is wrong."""

_NOISE_ORDER = 3
"""Order of the differences of the output that remove its motion."""

_STRETCHES, _LEAST = 100, 64
"""Number of stretches of a long record, of which the quietest show the noise, and
smallest number of samples in each."""

_QUIETEST, _DEVIATE = 0.05, -1.6449
"""Share of the quietest stretches, and the deviate of the normal distribution below
which that share lies."""

_CORRELATED = 2.31
"""Samples of the third difference of white noise for one degree of freedom of its
variance: 1 + 2 (15^2 + 6^2 + 1) / 20^2, by its autocovariances 20, -15, 6 and -1."""


def recognised(path: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Return the columns ``time``, ``input`` and ``output`` of the file at ``path``.

    Columns that are None in ``given`` are recognised: time by its name or unit, input
    as the only column in V (or mV, kV), output as the only one in um (or nm, mm). Of
    two signals without units the first is the input. The other keys of ``given`` are
    returned unchanged. Raises ValueError, listing the columns with their units, if no
    column or several qualify as input or output, and if the ``rate`` in ``given`` is
    not that of a column of time.
    """
    columns = read_columns(path)
    found = dict(given)
    clocks = [name for name, column in columns.items() if is_clock(name, column)]
    counts = [n for n in clocks if (unit_of(n, columns[n]) or "s") in SECONDS]
    if found.get("rate") is not None:
        for name in counts:
            _check_rate(path, name, columns[name], found["rate"])
    elif found.get("time") is None:
        found["time"] = next(iter(counts), None)
    signals = [name for name in columns if name not in (*clocks, found.get("time"))]
    units = {name: unit_of(name, columns[name]) for name in signals}
    for role, unit in _QUANTITIES.items():
        if found.get(role) is not None:
            continue
        free = [name for name in signals if name not in found.values()]
        of_kind = [n for n in free if units[n] and factor(str(units[n]), unit)]
        if not of_kind and len(signals) == 2 and not any(units.values()):
            of_kind = [signals[list(_QUANTITIES).index(role)]]
        if len(of_kind) != 1:
            raise ValueError(
                f"{path.name}: {len(of_kind)} columns are in {unit} or a multiple of "
                f"it; name the {role} with --{role}: there are {_listed(columns)}"
                f"{response_hint(columns)}"
            )
        found[role] = of_kind[0]
    return found


def _check_rate(path: Path, name: str, column: Column, rate: float) -> None:
    """Raise ValueError if the column of time ``name`` has another rate, Hz."""
    time = column.values * seconds_of(name, column)
    with np.errstate(invalid="ignore", divide="ignore"):
        own = (time.size - 1) / (time[-1] - time[0]) if time.size else np.nan
    if np.isfinite(own) and own > 0.0 and abs(own / rate - 1.0) > CONTRADICTED:
        raise ValueError(
            f"{path.name}: --rate is {rate:g} Hz, but the column {name!r} has "
            f"{own:.6g} Hz: leave out --rate, or remove the column if it is wrong; "
            "--resample changes the rate"
        )


def _listed(columns: Columns) -> str:
    units = {name: unit_of(name, column) for name, column in columns.items()}
    return ", ".join(f"{n} [{u}]" if u else f"{n} (no unit)" for n, u in units.items())


def noise_rms(record: Record) -> float:
    """Return the rms noise of the only output of ``record``, in its unit.

    White noise is assumed: the third difference of the output removes slow motion and
    has 20 times the variance of the noise. The estimate comes from the quietest part of
    the record, in which the stage rests or moves slowly. The bias from choosing the
    quietest part is corrected (Wilson-Hilferty). The noise includes the rounding of a
    converter. The estimate is wrong for a sensor with a low-pass, and for a stage that
    never moves slowly.
    """
    moved = np.diff(record.output, _NOISE_ORDER)
    size = min(max(moved.size // _STRETCHES, _LEAST), moved.size)
    whole = moved[: moved.size // size * size].reshape(-1, size)
    scale = np.sqrt(comb(2 * _NOISE_ORDER, _NOISE_ORDER))
    rms = np.sqrt(np.mean(whole**2, axis=1)) / scale
    spread = 2.0 / 9.0 * _CORRELATED / size
    quietest = (1.0 - spread + _DEVIATE * np.sqrt(spread)) ** 1.5
    return float(np.quantile(rms, _QUIETEST) / quietest)
