"""Designs of controllers by name, with their settings in a study."""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ..control.design import DESIGNS
from ..control.devices import DEVICE_DESIGNS
from ..core.plain import shown
from ..core.system import System
from .tables import one_of

ALL_DESIGNS: Mapping[str, Callable[..., System]] = DESIGNS | DEVICE_DESIGNS


def design_of(table: Mapping[str, Any]) -> Callable[..., System]:
    """Return the design that ``table`` names, with the settings of the table.

    The settings are the keyword arguments of the design. Raises ValueError for an
    unknown design, and for an unknown, missing or wrong setting.
    """
    settings = dict(table)
    name = one_of(settings.pop("design"), ALL_DESIGNS)
    design = ALL_DESIGNS[name]
    known = {
        parameter.name: parameter
        for parameter in inspect.signature(design).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    }
    for key, value in settings.items():
        if key not in known:
            expected = (
                f"its settings are {', '.join(known)}" if known else "it has none"
            )
            raise ValueError(f"{name} has no setting {shown(key)}; {expected}")
        settings[key] = _checked(key, value, known[key].annotation)
    for key, parameter in known.items():
        if parameter.default is parameter.empty and key not in settings:
            raise ValueError(f"{name} needs the setting {key!r}")
    return partial(design, **settings)


def _checked(key: str, value: Any, kind: Any) -> Any:
    try:
        return TypeAdapter(kind).validate_python(value, strict=False)
    except ValidationError as error:
        reason = error.errors()[0]["msg"]
        raise ValueError(f"the setting {key!r} is {shown(value)}: {reason}") from None
