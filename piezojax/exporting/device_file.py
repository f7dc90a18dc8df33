"""Parameters of a device as text, with its digits and checked against its ranges."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..core.parameter import declarations

DIGITS = 12
"""Significant digits of a number without a declared step."""


class Value(NamedTuple):
    """A parameter in the file of a device: key, text of the value, unit and meaning.

    ``saved`` is the text in the file saved from the device, or "" if it has none.
    """

    parameter: str
    value: str
    unit: str
    meaning: str
    saved: str = ""


class DeviceFile(NamedTuple):
    """Format of the parameter file of a device.

    ``values`` returns the values of a device whose parameters are rounded already.
    ``notes`` returns the sentences at the head of the file, given the device and the
    keys and values of the saved file. ``read`` returns the keys and values of a saved
    file; it raises ValueError for a file of another kind. ``body`` returns the text of
    the values, given the text of the saved file; some formats keep its other keys.
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
    """Return a field of ``device`` under ``key``, by default the name of the field.

    Raises ValueError for a value outside the limits of the field or outside ``least``
    to ``most``; the message states the range.
    """
    declared, value = dict(declarations(device))[field], getattr(device, field)
    limits = {"least": max(declared.least, least), "most": min(declared.most, most)}
    name = f"{field} ({key})" if key else field
    dataclasses.replace(declared, **limits).check(name, value)
    text = number(value, declared.step)
    return Value(key or field, text, declared.unit, declared.meaning)


def number(value: Any, step: float | None = None) -> str:
    """Return ``value`` without an exponent, which some devices cannot read.

    The text has the decimals of ``step``; without a step, up to 12 significant digits.
    """
    if step is None:
        return np.format_float_positional(
            float(value) + 0.0, precision=DIGITS, fractional=False, trim="-"
        )
    decimals = max(0, -int(np.floor(np.log10(step))))
    return f"{float(value) + 0.0:.{decimals}f}"
