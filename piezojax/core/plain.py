"""Reading of TOML and JSON files as plain tables, with one-line errors."""

import json
import tomllib
from pathlib import Path
from typing import Any, Literal

DEEPEST = 64
"""Largest depth to which tables and lists in a file may be nested."""

SHOWN = 80
"""Largest number of characters of a value in a message."""


def read_plain(path: Path, kind: Literal["toml", "json"], name: str) -> Any:
    """Return the content of the TOML or JSON file ``path``.

    ``name`` is the name of the file in errors. Raises ValueError, one line, for a file
    that cannot be read or has other content, for tables nested more than DEEPEST deep,
    for an integer beyond the range of a float, and for a key with control characters,
    such as a line end.
    """
    try:
        text = path.read_text(encoding="utf-8")
        data = tomllib.loads(text) if kind == "toml" else json.loads(text)
    except OSError as error:
        raise ValueError(f"{name}: {error.strerror}") from None
    except RecursionError:
        raise ValueError(_too_deep(name)) from None
    except ValueError as error:  # of the decoder, or an integer of 4301 digits or more
        raise ValueError(f"{name} is not a {kind.upper()} file: {error}") from None
    _check(data, name)
    return data


def shown(value: Any) -> str:
    """Return ``repr(value)``, cut to SHOWN characters."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def _too_deep(name: str) -> str:
    return f"{name} nests tables or lists more than {DEEPEST} deep"


def _check(data: Any, name: str) -> None:
    """Raise ValueError for tables nested too deep and for integers too large."""
    level = {"": data}
    for _ in range(DEEPEST + 1):
        inner = {}
        for place, value in level.items():
            if isinstance(value, dict | list):
                pairs = value.items() if isinstance(value, dict) else enumerate(value)
                _check_keys(value, f"{name}: {place.lstrip('.')}")
                inner |= {f"{place}.{key}": item for key, item in pairs}
            elif isinstance(value, int):
                _check_integer(value, f"{name}: {place.lstrip('.')}")
        level = inner
    if level:
        raise ValueError(_too_deep(name))


def _check_keys(table: dict | list, where: str) -> None:
    for key in table if isinstance(table, dict) else ():
        if not key.isprintable():
            raise ValueError(
                f"{where} has the key {shown(key)}, which holds control characters"
            )


def _check_integer(value: int, where: str) -> None:
    try:
        float(value)
    except OverflowError:
        raise ValueError(
            f"{where} is {shown(value)}; the largest number is 1.8e308"
        ) from None
