"""Systems by name: those of installed packages, and those that a user registers."""

import inspect
from functools import cache
from importlib.metadata import entry_points
from typing import TypeVar

from .system import System

ENTRY_POINTS = "piezojax.systems"
"""Group of the entry points that name modules whose exported Systems are known; the
models and controllers of piezojax come in by it, too."""

S = TypeVar("S", bound=System)

_registered: dict[str, type[System]] = {}


def register(kind: type[S]) -> type[S]:
    """Make ``kind`` known by its class name, to files as to fits; a class decorator.

    Raises TypeError for what is no System, ValueError for a name that another has.
    """
    if not (isinstance(kind, type) and issubclass(kind, System)):
        raise TypeError(f"{kind!r} is no System; only a System can be registered")
    other = _registered.setdefault(kind.__name__, kind)
    if (other.__module__, other.__qualname__) != (kind.__module__, kind.__qualname__):
        raise ValueError(
            f"the name {kind.__name__} is taken by {other.__module__}; choose another"
        )
    _registered[kind.__name__] = kind
    return kind


@cache
def _discover() -> None:
    for point in entry_points(group=ENTRY_POINTS):
        for value in vars(point.load()).values():
            if isinstance(value, type) and issubclass(value, System):
                register(value)


def kinds() -> dict[str, type[System]]:
    """Return every known System class by its name."""
    _discover()
    return {
        name: kind
        for name, kind in sorted(_registered.items())
        if not inspect.isabstract(kind)
    }
