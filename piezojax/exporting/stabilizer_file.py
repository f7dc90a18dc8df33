"""Settings of the Stabilizer for its client miniconf, with the signs of its biquad."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..control import Stabilizer
from .device_file import DeviceFile, Value, value_of

END = 10.24
"""Largest voltage of the converters, V."""

PLACE = "/ch/0/biquad/0"


def _values(device: Stabilizer) -> list[Value]:
    loop = device.loop()
    rows = (loop.forward, (1.0, *(-a for a in loop.back)))
    text = ",".join(f"[{','.join(_single(x) for x in row)}]" for row in rows)
    ends = (
        value_of(device, field, f"{PLACE}/repr/Ba/{key}", least=-END, most=END)
        for field, key in (("minimum", "min"), ("maximum", "max"))
    )
    meaning = "coefficients [[b0,b1,b2],[a0,a1,a2]]"
    return [
        Value(f"{PLACE}/typ", '"Ba"', "1", "form of the biquad"),
        Value(f"{PLACE}/repr/Ba/ba", f"[{text}]", "V/V", meaning),
        *ends,
    ]


def _single(value: Any) -> str:
    """Return the shortest text of a number in single precision."""
    return np.format_float_positional(np.float32(value) + np.float32(0.0), trim="-")


def _notes(device: Stabilizer, saved: Mapping[str, str]) -> list[str]:
    names = ("p", "i", "d", "limit_i", "limit_d")
    gains = ", ".join(f"{name} {float(getattr(device, name)):.9g}" for name in names)
    return [
        "y = b0 x + b1 x1 + b2 x2 - a1 y1 - a2 y2 with a0 = 1: a1 and a2 have the "
        "signs of textbooks; x is the input and y the output; x1, y1 are one sample "
        "old, x2, y2 two samples.",
        "This file needs firmware with repr (idsp 0.20 or later). The array "
        "ba = [b0,b1,b2,a1,a2] of v0.11 has the same signs; v0.8 and v0.9 add a1 y1 "
        "and a2 y2: change both signs.",
        f"The same biquad as typ Pid with order I: {gains}.",
        "Set the field u (offset in later versions) to -(b0 + b1 + b2) times the set "
        "point in V; it is not in this file.",
        "The paths name channel 0 and biquad 0: change them for others. Send each line "
        "with python -m miniconf -b mqtt -d dt/sinara/dual-iir/+ and read it back.",
    ]


def _read(text: str) -> dict[str, str]:
    lines = (line.strip() for line in text.splitlines())
    pairs = (line.partition("=") for line in lines if line.startswith("/"))
    found = {key.strip(): value.strip() for key, sign, value in pairs if sign}
    if not found:
        raise ValueError(f"no settings of a Stabilizer, such as '{PLACE}/typ=\"Ba\"'")
    return found


def _body(values: Sequence[Value], saved: str) -> str:
    return "".join(f"{value.parameter}={value.value}\n" for value in values)


STABILIZER_FILE = DeviceFile(".conf", _values, _notes, _read, _body)
