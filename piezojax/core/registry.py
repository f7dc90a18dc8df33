"""Registry of Systems by name, from installed packages and from the user."""

import inspect
from functools import cache
from importlib.metadata import entry_points
from typing import TypeVar

from .recipe import PLACES, Fittable
from .system import System

ENTRY_POINTS = "piezojax.extensions"
"""Group of entry points. Each names a System, a module that exports Systems, or a
module that extends a table of piezojax, such as its constraints. piezojax registers its
own models and controllers through it."""

S = TypeVar("S", bound=System)

_registered: dict[str, type[System]] = {}


def register(kind: type[S]) -> type[S]:
    """Register the class ``kind`` by its name and return it; usable as a decorator.

    A registered System can be saved and loaded; a Fittable can also be listed and
    fitted, by the name in its Part. Raises TypeError for a class that is not a System,
    and ValueError for a name that another class has or an unknown place in a chain.
    """
    discover()
    return _add(kind)


def _add(kind: type[S]) -> type[S]:
    if not (isinstance(kind, type) and issubclass(kind, System)):
        raise TypeError(f"{kind!r} is not a System; only a System can be registered")
    other = _registered.get(kind.__name__, kind)
    if not _same(other, kind):
        raise ValueError(
            f"the name {kind.__name__} is taken by {other.__module__}; choose another"
        )
    if issubclass(kind, Fittable) and not inspect.isabstract(kind):
        _check_part(kind)
    _registered[kind.__name__] = kind
    return kind


def _same(kind: type, other: type) -> bool:
    names = kind.__module__, kind.__qualname__
    return names == (other.__module__, other.__qualname__)


def _check_part(kind: type[Fittable]) -> None:
    part = kind.part
    if part.place not in PLACES:
        raise ValueError(
            f"{kind.__name__}.part.place is {part.place!r}; it must be one of "
            f"{', '.join(PLACES)}"
        )
    for other in _fittable():
        if other.part.name == part.name and not _same(other, kind):
            raise ValueError(
                f"{kind.__name__}.part.name is {part.name!r}, the name of "
                f"{other.__name__}; choose another"
            )


@cache
def discover() -> None:
    """Load the modules of installed packages once, with their Systems and tables."""
    for point in entry_points(group=ENTRY_POINTS):
        loaded = point.load()
        for value in [loaded] if isinstance(loaded, type) else vars(loaded).values():
            if isinstance(value, type) and issubclass(value, System):
                _add(value)


def _fittable() -> list[type[Fittable]]:
    return [
        kind
        for kind in _registered.values()
        if issubclass(kind, Fittable) and not inspect.isabstract(kind)
    ]


def kinds() -> dict[str, type[System]]:
    """Return the registered System classes that are not abstract, by class name."""
    discover()
    return {
        name: kind
        for name, kind in sorted(_registered.items())
        if not inspect.isabstract(kind)
    }


def parts() -> dict[str, type[Fittable]]:
    """Return the registered Fittable classes by the names in their Parts.

    They are ordered by place in a chain, then as their packages export them.
    """
    discover()
    ordered = sorted(_fittable(), key=lambda kind: PLACES.index(kind.part.place))
    return {kind.part.name: kind for kind in ordered}
