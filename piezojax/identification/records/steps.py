"""Sample times that a file states as a scalar or an attribute."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from .columns import ContentError

_STEP = re.compile(r"(dt|ts|tsample|sampl(e|ing)_?(time|interval|period))(_s)?$")
_RATE = re.compile(r"(fs|sampl(e|ing)_?(rate|frequency|freq)|rate_hz)(_hz)?$")

AGREE = 1e-3
"""Largest relative difference of two statements of one sample time."""


def stated_step(scalars: Mapping[str, Any]) -> float | None:
    """Return the sample time (s) among named scalars, or None if there is none.

    A time is called ``dt``, ``Ts`` or as in ``sample_time``; a rate (Hz) ``fs`` or as
    in ``sampling_rate``. Raises ContentError for a value that is not a positive number,
    and for values that contradict each other.
    """
    known = {}
    for name, value in scalars.items():
        word = re.sub(r"[\s-]", "_", name.strip().lower())
        if np.size(value) == 1 and (_STEP.match(word) or _RATE.match(word)):
            number = _positive(name, value)
            known[name] = 1.0 / number if _RATE.match(word) else number
    steps = list(known.values())
    if steps and max(steps) - min(steps) > AGREE * max(steps):
        listed = ", ".join(f"{name} ({step:g} s)" for name, step in known.items())
        raise ContentError(
            f"the sample times in the file contradict each other: {listed}"
        )
    return steps[0] if steps else None


def _positive(name: str, value: Any) -> float:
    try:
        number = float(np.asarray(value).item())
    except (TypeError, ValueError):
        number = np.nan
    if not (np.isfinite(number) and number > 0.0 and np.isfinite(1.0 / number)):
        shown = np.asarray(value).tolist()
        raise ContentError(f"{name} is {shown!r}; it must be a number above 0")
    return number
