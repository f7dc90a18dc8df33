"""Parameters of a study that are tuned: their paths, ranges and starts."""

import dataclasses
from collections.abc import Iterable

import jax.numpy as jnp

from ..core.paths import declared, get, matching, replace
from ..core.serial import from_data, to_data
from ..core.space import Range, Space, space_of
from ..core.system import Feedback
from .schema import Study, TunedTable

PART = "controller."
"""Start of the paths that may be tuned; the stage is not for tuning."""


def search_space(study: Study, loop: Feedback) -> tuple[Feedback, Space]:
    """Return ``loop`` with the starts of the study, and the Space of what is tuned.

    Raises ValueError, one line naming the path, for one that is no number of the
    controller, has no range, or starts outside it, and for a start or a bound that the
    controller refuses.
    """
    ranges = _ranges(study, loop)
    starts = {path: r.start for path, r in ranges.items() if r.start is not None}
    loop, space = replace(loop, starts), space_of(ranges)
    space.start(loop)
    for path, one in ranges.items():
        _check_values(loop, path, one)
    return loop, space


def _ranges(study: Study, loop: Feedback) -> dict[str, Range]:
    """Return the Range of each tuned parameter: those of ``[parameters]``, then those
    that ``tune`` alone names, in the order of the loop."""
    tables = dict(study.parameters)
    for path in study.parameters:
        _check_path(loop, path, f"parameters.{path}")
    for pattern in study.tune:
        for path in _named(loop, pattern):
            tables.setdefault(path, TunedTable())
    return {
        path: dataclasses.replace(
            table.range(declared(loop, path), f"parameters.{path}"), start=table.start
        )
        for path, table in tables.items()
    }


def _check_values(loop: Feedback, path: str, wanted: Range) -> None:
    """Build the controller at the start and the bounds, to run its own checks."""
    for name in ("start", "lower", "upper"):
        value = getattr(wanted, name)
        if value is None:
            continue
        try:
            from_data(to_data(replace(loop, {path: value}).controller))
        except ValueError as error:
            raise ValueError(f"parameters.{path}.{name}: {error}") from None


def _named(loop: Feedback, pattern: str) -> Iterable[str]:
    """Return the paths that one entry of ``tune`` names."""
    if not set("*?[") & set(pattern):
        _check_path(loop, pattern, f"tune: {pattern}")
        return [pattern]
    found = [
        path
        for path in matching(loop, pattern)
        if path.startswith(PART) and jnp.ndim(get(loop, path)) == 0
    ]
    known = [path for path in found if _has_range(loop, path)]
    if not known:
        what = "no declared range" if found else "no match in the controller"
        raise ValueError(
            f"tune: {pattern} has {what}; name paths under [parameters], as in "
            '"controller.cutoff" = { lower = 100.0, upper = 2e4 }'
        )
    return known


def _has_range(loop: Feedback, path: str) -> bool:
    found = declared(loop, path)
    return found is not None and found.typical is not None


def _check_path(loop: Feedback, path: str, where: str) -> None:
    if not path.startswith(PART):
        raise ValueError(
            f"{where}: the path must start with {PART!r}; the stage is not for tuning"
        )
    shape = jnp.shape(get(loop, path))
    if shape:
        raise ValueError(f"{where} has shape {shape}; it must be a number")
