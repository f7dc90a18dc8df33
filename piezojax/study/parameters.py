"""Tuned parameters of a study: their paths, ranges and starts."""

import dataclasses
from collections.abc import Iterable

import jax.numpy as jnp

from ..core.feedback import Feedback
from ..core.paths import declared, get, matching, replace
from ..core.serial import from_data, to_data
from ..core.space import Range, Space, space_of
from ..core.system import System
from .schema import Study
from .search_tables import TunedTable

PART = "controller."
"""Prefix of every tuned path; parameters of the stage are not tuned."""


def search_space(
    study: Study, loop: Feedback
) -> tuple[Feedback, Space, tuple[str, ...]]:
    """Return ``loop`` with the starts of the study, its Space, and notes on starts.

    A parameter that only a pattern of ``tune`` matches may be 0 in the controller
    (switched off), although a ``log`` or ``logit`` scale excludes 0. The search then
    starts from the lower bound of the range, and a note says so.

    Raises ValueError, naming the path, for a path that is not a scalar of the
    controller, for a parameter without a range or with a start outside it, and for a
    start or a bound that the controller refuses.
    """
    ranges, notes = _ranges(study, loop)
    starts = {path: r.start for path, r in ranges.items() if r.start is not None}
    loop, space = replace(loop, starts), space_of(ranges)
    space.start(loop)
    for path, bounds in ranges.items():
        for name in ("start", "lower", "upper"):
            value = getattr(bounds, name)
            if value is not None:
                inner, where = path.removeprefix(PART), f"parameters.{path}.{name}"
                check_value(loop.controller, inner, value, where)
    return loop, space, notes


def _ranges(study: Study, loop: Feedback) -> tuple[dict[str, Range], tuple[str, ...]]:
    """Return the Range of each tuned parameter by path, and notes on their starts.

    The parameters of ``[parameters]`` come first. Those that only ``tune`` names
    follow; the matches of a pattern are in the order of the loop.
    """
    tables = dict(study.parameters)
    for path in study.parameters:
        _check_path(loop, path, f"parameters.{path}")
    for pattern in study.tune:
        for path in _tuned_paths(loop, pattern):
            tables.setdefault(path, TunedTable())
    ranges = {path: _range(loop, path, table) for path, table in tables.items()}
    for path in tables.keys() - study.parameters.keys():
        bounds = _reaching(ranges[path], float(get(loop, path)))
        ranges[path] = bounds.limited(declared(loop, path))
    notes = []
    for path in sorted(tables.keys() - {*study.parameters, *study.tune}):
        bounds, value, known = (
            ranges[path],
            float(get(loop, path)),
            declared(loop, path),
        )
        if bounds.scale != "linear" and value == 0.0:
            start, bound = bounds.lower, "lower"
            why = f"0 in the controller, outside its {bounds.scale} scale"
        elif known is not None and known.switched and value > bounds.upper:
            # The frequency of a filter that is off may be any.
            start, bound, why = bounds.upper, "upper", "above half the sampling rate"
        else:
            continue
        ranges[path] = dataclasses.replace(bounds, start=start)
        notes.append(
            f"{path} is {why}; the search starts from its {bound} bound, {start:g}"
        )
    return ranges, tuple(notes)


def _range(loop: Feedback, path: str, table: TunedTable) -> Range:
    where, start, known = f"parameters.{path}", table.start, declared(loop, path)
    table = table.bounded(float(get(loop, path)) if start is None else start, where)
    bounds = dataclasses.replace(table.range(known, where), start=start)
    return bounds if table.within is None else bounds.limited(known)


def _reaching(bounds: Range, start: float) -> Range:
    """Return ``bounds``, extended to a decade beyond a ``start`` on or outside them.

    Only bounds on a logarithmic scale are extended. Declared ranges suit common
    controllers; a design may start outside them.
    """
    if bounds.scale != "log" or start <= 0.0:
        return bounds
    lower, upper = bounds.lower, bounds.upper
    return dataclasses.replace(
        bounds,
        lower=lower if start > lower else start / 10.0,
        upper=upper if start < upper else start * 10.0,
    )


def check_value(system: System, path: str, value: float, where: str) -> None:
    """Rebuild ``system`` with ``value`` at ``path``, so that its constructors check it.

    Raises ValueError, starting with ``where``, if a constructor refuses the value or if
    it is outside the declared limits.
    """
    changed = to_data(replace(system, {path: value}))
    try:
        from_data(changed)
    except ValueError as error:
        # from_data starts with the place in the System, which ``where`` already names.
        reason = str(error).split(": ", 1)[-1]
        raise ValueError(f"{where}: {reason}") from None
    # A constructor does not check the frequencies of filters that are off.
    declaration = declared(system, path)
    if declaration is not None:
        declaration.check(f"{where}: {path.split('.')[-1]}", value)


def _tuned_paths(loop: Feedback, pattern: str) -> Iterable[str]:
    """Return the paths that match one entry of ``tune``.

    A pattern matches only scalars with a declared range.
    """
    if not set("*?[") & set(pattern):
        _check_path(loop, pattern, f"tune: {pattern}")
        return [pattern]
    scalars = [
        path
        for path in matching(loop, pattern)
        if path.startswith(PART) and jnp.ndim(get(loop, path)) == 0
    ]
    tunable = [path for path in scalars if _has_range(loop, path)]
    if not tunable:
        lack = "no declared range" if scalars else "no match in the controller"
        raise ValueError(
            f"tune: {pattern} has {lack}; name paths under [parameters], as in "
            '"controller.cutoff" = { lower = 100.0, upper = 2e4 }'
        )
    return tunable


def _has_range(loop: Feedback, path: str) -> bool:
    declaration = declared(loop, path)
    return declaration is not None and declaration.typical is not None


def _check_path(loop: Feedback, path: str, where: str) -> None:
    if not path.startswith(PART):
        raise ValueError(
            f"{where}: the path must start with {PART!r}; the stage is not tuned"
        )
    shape = jnp.shape(get(loop, path))
    if shape:
        raise ValueError(f"{where} has shape {shape}; it must be a number")
