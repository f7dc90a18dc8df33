"""Parameters of a device as text, in its range and with its digits."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..core.parameter import declarations

DIGITS = 12
"""Significant digits of a number for which a device declares no step."""


class Value(NamedTuple):
    """A value in a file of a device: its key and text there, unit and meaning.

    ``saved`` is its text in the file saved before, "" if that lacks it.
    """

    parameter: str
    value: str
    unit: str
    meaning: str
    saved: str = ""


class DeviceFile(NamedTuple):
    """File of the parameters of a device.

    ``values`` returns the values of a device that is rounded already, and ``notes`` the
    sentences at the head of the file, given the keys and values of the file saved
    before. ``read`` returns the keys and values of such a file; it raises ValueError
    for another file. ``body`` returns the text of the values, and of the other keys in
    the text of the saved file if it keeps them.
    """

    suffix: str
    values: Callable[[Any], list[Value]]
    notes: Callable[[Any, Mapping[str, str]], list[str]]
    read: Callable[[str], dict[str, str]]
    body: Callable[[Sequence[Value], str], str]


def value_of(
    device: Any,
    field: str,
    key: str = "",
    *,
    least: float = -np.inf,
    most: float = np.inf,
) -> Value:
    """Return a field of ``device`` under ``key``, by default its name.

    Raises ValueError, with the range, for a value outside the limits of the field or
    outside ``least`` to ``most``.
    """
    declared, value = dict(declarations(device))[field], getattr(device, field)
    limits = {"least": max(declared.least, least), "most": min(declared.most, most)}
    name = f"{field} ({key})" if key else field
    dataclasses.replace(declared, **limits).check(name, value)
    text = number(value, declared.step)
    return Value(key or field, text, declared.unit, declared.meaning)


def number(value: Any, step: float | None = None) -> str:
    """Return ``value`` without an exponent, which not every device reads.

    It has the decimals of ``step``, or up to 12 significant digits without one.
    """
    if step is None:
        return np.format_float_positional(
            float(value) + 0.0, precision=DIGITS, fractional=False, trim="-"
        )
    decimals = max(0, -int(np.floor(np.log10(step))))
    return f"{float(value) + 0.0:.{decimals}f}"
