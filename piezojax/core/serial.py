"""Conversion of Systems to and from plain data, without code, in TOML or JSON files."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin

import equinox as eqx
import numpy as np
import tomli_w
from pydantic import ValidationError

from .about import About
from .files import write_text
from .plain import read_plain, shown
from .registry import kinds
from .system import System

_ABOUT = "about"
"""Key of the table in a file that describes the origin of its System."""


def to_data(system: System) -> dict[str, Any]:
    """Return ``system`` as nested tables of numbers and strings.

    Raises ValueError for a System of a class that is not registered.
    """
    name = type(system).__name__
    if kinds().get(name) is not type(system):
        raise ValueError(
            f"{name} cannot be saved; register its class with piezojax.register"
        )
    data: dict[str, Any] = {"type": name}
    for field in dataclasses.fields(system):
        data[field.name] = _value_to_data(getattr(system, field.name))
    return data


def _value_to_data(value: Any) -> Any:
    if isinstance(value, System):
        return to_data(value)
    if eqx.is_array(value):
        return np.asarray(value).tolist()
    if isinstance(value, tuple):
        return [_value_to_data(item) for item in value]
    return value


def from_data(data: Any, where: str = "system") -> System:
    """Return the System that ``data`` from ``to_data`` describes.

    ``where`` is the name of ``data`` in errors. Parts may be Systems already. Raises
    ValueError, naming the key, the value and the allowed values.
    """
    known = kinds()
    allowed = ", ".join(known)
    if not isinstance(data, Mapping) or "type" not in data:
        raise ValueError(f"{where} needs a key 'type' with one of {allowed}")
    kind = known.get(data["type"]) if isinstance(data["type"], str) else None
    if kind is None:
        raise ValueError(
            f"{where}.type is {shown(data['type'])}; it must be one of {allowed}"
        )
    fields = {field.name: field for field in dataclasses.fields(kind)}
    arguments = {key: value for key, value in data.items() if key != "type"}
    for key in arguments:
        if key not in fields:
            raise ValueError(
                f"{where}.{key} is unknown; {kind.__name__} has {', '.join(fields)}"
            )
    built = {
        key: _value_from_data(value, fields[key].type, f"{where}.{key}")
        for key, value in arguments.items()
    }
    missing = [
        name
        for name, field in fields.items()
        if name not in built and field.default is dataclasses.MISSING
    ]
    if missing:
        raise ValueError(f"{where}.{missing[0]} is missing")
    try:
        return kind(**built)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _value_from_data(value: Any, kind: Any, where: str) -> Any:
    """Return ``value`` converted for a field of type ``kind``."""
    if isinstance(kind, UnionType):
        kind = min(get_args(kind), key=lambda arm: abs(_levels(arm) - _nested(value)))
    if get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{where} is {shown(value)}; it must be a list")
        (item, _) = get_args(kind)
        return tuple(
            _value_from_data(v, item, f"{where}.{i}") for i, v in enumerate(value)
        )
    if isinstance(kind, type) and issubclass(kind, System):
        system = value if isinstance(value, System) else from_data(value, where)
        if not isinstance(system, kind):
            raise ValueError(
                f"{where} is of type {type(system).__name__}; "
                f"it must be {kind.__name__}"
            )
        return system
    rank = len(getattr(kind, "dims", ()))
    if rank:
        return _array_from_data(value, rank, where)
    accepted, name = _PLAIN.get(kind, ((int, float), "a number"))
    if not isinstance(value, accepted) or isinstance(value, bool):
        raise ValueError(f"{where} is {shown(value)}; it must be {name}")
    return value


def _levels(kind: Any) -> int:
    """Return the depth of nested lists in a field of type ``kind``."""
    return 1 + _levels(get_args(kind)[0]) if get_origin(kind) is tuple else 0


def _nested(value: Any) -> int:
    """Return the depth of nested lists in ``value``, by its first elements."""
    if not isinstance(value, list | tuple):
        return 0
    return 1 + (_nested(value[0]) if value else 0)


def _array_from_data(value: Any, rank: int, where: str) -> np.ndarray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.ndim != rank:
        kind = "numbers" if rank == 1 else "rows of numbers, all of one length"
        raise ValueError(f"{where} is {shown(value)}; it must be a list of {kind}")
    return array


_PLAIN: dict[Any, tuple[Any, str]] = {
    str: (str, "a text"),
    int: (int, "a whole number"),
}
"""Accepted types, and their names in errors; any other field takes a number."""


def save(system: System, path: str | Path, about: About | None = None) -> None:
    """Write ``system`` to ``path`` (``.toml`` or ``.json``) atomically.

    ``about`` is written to the same file, as the table of that name. Raises ValueError
    for a System that ``load`` would reject: its class is not registered, or a parameter
    is outside its limits.
    """
    path, data = Path(path), to_data(system)
    from_data(data, path.name)
    if about is not None:
        data[_ABOUT] = about.model_dump(exclude_none=True)
    if _format(path) == "toml":
        write_text(path, tomli_w.dumps(data))
    else:
        write_text(path, json.dumps(data, indent=2) + "\n")


def load(path: str | Path, *, accept_unsafe: bool = False) -> System:
    """Return the System in the file ``path``, written by ``save``.

    Raises ValueError for a file that is missing, is not TOML or JSON, or describes no
    System. A file that was written with an alarm (``About.unsafe``) is refused too,
    unless ``accept_unsafe``.
    """
    path = Path(path)
    data = _read(path)
    about = _about_of(data.pop(_ABOUT, {}), path)
    if not accept_unsafe:
        about.require_safe(path.name, "pass accept_unsafe=True to load it anyway")
    return from_data(data, path.name)


def read_about(path: str | Path) -> About:
    """Return the table ``about`` of a file written by ``save``.

    A file without it gives an About of an unknown version. Raises ValueError for a file
    that is missing, is not TOML or JSON, or holds another table of that name.
    """
    path = Path(path)
    return _about_of(_read(path).get(_ABOUT, {}), path)


def _about_of(table: Any, path: Path) -> About:
    if not isinstance(table, dict):
        raise ValueError(f"{path.name}: {_ABOUT} is {table!r}; it must be a table")
    try:
        return About.model_validate({"piezojax": "unknown"} | table)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, (_ABOUT, *first["loc"])))
        raise ValueError(f"{path.name}: {key}: {first['msg']}") from None


def _read(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML or JSON file. Raises ValueError as ``load``."""
    data = read_plain(path, _format(path), str(path))
    if not isinstance(data, dict):
        raise ValueError(f"{path.name} needs a key 'type' and the fields of a System")
    return data


def _format(path: Path) -> Literal["toml", "json"]:
    match path.suffix.lower():
        case ".toml":
            return "toml"
        case ".json":
            return "json"
    raise ValueError(f"{path}: the name must end in .toml or .json")
