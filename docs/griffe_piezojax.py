"""Extension of griffe for the API pages: exported names, and fields of Systems."""

import ast
import dataclasses
import importlib
from collections.abc import Iterator
from typing import Any

import griffe
import numpy as np

from piezojax.core.parameter import Parameter, declarations
from piezojax.core.system import System

HEADER = """\
| field | unit | default | limits | search range | meaning |
|---|---|---|---|---|---|
"""


class Piezojax(griffe.Extension):
    """Export ``from .pid import PID as PID``, and list the fields of Systems.

    The docstring of a System gets a table of its fields. Units, limits, search ranges
    and meanings are those of the declarations.
    """

    def on_module_members(self, *, mod: griffe.Module, **kwargs: Any) -> None:
        path = mod.filepath
        if isinstance(path, list) or path.name != "__init__.py":
            return
        stub = path.with_suffix(".pyi")
        tree = ast.parse((stub if stub.exists() else path).read_text(encoding="utf-8"))
        exported = [
            alias.name
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
            if alias.name == alias.asname
        ]
        own = [name for name, member in mod.members.items() if not member.is_alias]
        mod.exports = [*exported, *(name for name in own if not name.startswith("_"))]

    def on_class_members(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        kind = getattr(importlib.import_module(cls.module.path), cls.name, None)
        if not (isinstance(kind, type) and issubclass(kind, System) and cls.docstring):
            return
        rows = list(_rows(kind, cls))
        if rows:
            table = HEADER + "\n".join(rows)
            cls.docstring.value = f"{cls.docstring.value}\n\n{table}\n"


def _rows(kind: type[System], cls: griffe.Class) -> Iterator[str]:
    """Yield the row of each field of the constructor."""
    declared = dict(declarations(kind))
    for field in dataclasses.fields(kind):
        if not field.init:
            continue
        cells = [f"`{field.name}`", "", _default(field), "", "", ""]
        if field.name in declared:
            cells[1] = declared[field.name].unit
            cells[3:] = _declared(declared[field.name])
        elif field.name in cls.members:
            cells[5] = f"`{cls.members[field.name].annotation}`"
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default_factory is not dataclasses.MISSING:
        return "its own"
    if field.default is dataclasses.MISSING:
        return ""
    value = field.default
    return f"`{value!r}`" if np.ndim(value) == 0 and not callable(value) else ""


def _declared(parameter: Parameter) -> list[str]:
    """Return limits, search range and meaning."""
    signs = {"above": ">", "least": "≥", "below": "<", "most": "≤"}
    limits = [
        f"{sign} {getattr(parameter, name):g}"
        for name, sign in signs.items()
        if np.isfinite(getattr(parameter, name))
    ]
    search = ""
    if parameter.typical is not None:
        low, high = parameter.typical
        scale = "" if parameter.scale == "linear" else f", {parameter.scale}"
        search = f"{low:g} to {high:g}{scale}"
    return [", ".join(limits), search, parameter.meaning]
