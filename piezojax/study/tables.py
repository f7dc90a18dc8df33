"""Strict validation of the tables of a file, with one-line errors."""

import difflib
import re
from collections.abc import Iterable
from typing import Annotated, Any, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..core.parameter import Parameter, Scale
from ..core.plain import shown
from ..core.space import Range

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


class Table(BaseModel):
    """A table of a study; unknown keys are errors.

    The docstring below a field is its description in the schema of a study.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, use_attribute_docstrings=True
    )


def once(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return ``values``; raise ValueError if one of them is listed twice."""
    for value in values:
        if values.count(value) > 1:
            raise ValueError(f"{value} is listed twice")
    return values


def in_unit(name: str) -> Any:
    """Return an annotation of a field with its unit, for the schema of a study."""
    return Field(json_schema_extra={"unit": name})


def example(table: dict[str, Any]) -> ConfigDict:
    """Return the configuration of a Table with an example, for its schema."""
    return ConfigDict(json_schema_extra={"examples": [table]})


class RangeTable(Table):
    """Bounds and scale of a parameter; the bounds are in its unit.

    The declaration of the parameter supplies missing keys.
    """

    lower: Finite | None = None
    """Lower bound."""
    upper: Finite | None = None
    """Upper bound."""
    scale: Scale | None = None
    """Scale of the search, or of the spacing of points."""

    def range(self, declared: Parameter | None, where: str) -> Range:
        """Return the Range, with missing keys taken from ``declared``.

        Raises ValueError, naming the key, for a bound that is missing in both.
        """
        typical = Range.of(declared) if declared else None
        for key in ("lower", "upper"):
            if getattr(self, key) is None and typical is None:
                raise ValueError(
                    f"{where}.{key} is missing; no range is declared for this "
                    "parameter, so give it lower and upper"
                )
        base = typical or Range(
            -np.inf, np.inf, declared.scale if declared else "linear"
        )
        return Range(
            base.lower if self.lower is None else self.lower,
            base.upper if self.upper is None else self.upper,
            self.scale or base.scale,
            unit=declared.unit if declared else "",
            step=declared.step if declared else None,
        )


Each = TypeVar("Each")
ByAxis = Each | tuple[Each, ...]
"""One value for all axes, or a list with one value for each axis."""


def one_of(name: str, allowed: Any) -> str:
    """Return ``name``; raise ValueError, listing ``allowed``, if it is not in it."""
    if not isinstance(name, str) or name not in allowed:
        raise ValueError(f"{shown(name)} is unknown; there are {', '.join(allowed)}")
    return name


def unknown_key(key: str, name: str, known: Iterable[str]) -> str:
    """Return the message for an unknown ``name`` at ``key``, with the nearest known."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"{key} is unknown; allowed are {', '.join(known)}{hint}"


def validated(kind: type[Any], data: Any, where: str) -> Any:
    """Return ``data`` validated as ``kind``.

    Raises ValueError: one line with the key, the value and the allowed values.
    """
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise ValueError(_message(error, kind, where)) from None


def _table_in(annotation: Any) -> Any:
    """Return the Table type of an annotation: plain, optional, or values of a dict."""
    inner = [part for part in get_args(annotation) if part is not type(None)]
    return _table_in(inner[-1]) if inner else annotation


_UNION = re.compile(r"(constrained-)?(float|tuple\[.*)$")
"""Names that pydantic inserts into the location of an error in a union."""


def _message(error: ValidationError, kind: type[BaseModel], where: str) -> str:
    # A field that takes a number or a list has one error for each; lists come last.
    first = min(error.errors(), key=lambda entry: isinstance(entry["input"], list))
    place = [str(part) for part in first["loc"] if not _UNION.match(str(part))]
    key = ".".join([where, *place]).strip(".")
    if first["type"] == "extra_forbidden":
        table: Any = kind
        for part in first["loc"][:-1]:
            field = getattr(table, "model_fields", {}).get(part)
            table = _table_in(field.annotation if field else table)
        known = [field.alias or n for n, field in table.model_fields.items()]
        return unknown_key(key, str(first["loc"][-1]), known)
    if first["type"] == "missing":
        return f"{key} is missing"
    message = first["msg"].removeprefix("Value error, ")
    value = first["input"]
    is_value = f" is {shown(value)}" if isinstance(value, str | int | float) else ""
    return f"{key}{is_value}: {message}" if key else message
