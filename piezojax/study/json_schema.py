"""JSON schema of a study, with which editors complete and check its file."""

import math
from collections.abc import Iterable
from typing import Any

from ..analysis.constraints import CONSTRAINTS, OFF
from ..catalog import CONTROLLERS, PLANTS
from ..control.design import DESIGNS
from ..core.registry import kinds
from ..solve.optimisers import GAUSS_NEWTON, METHODS
from .schema import Study

DRAFT = "https://json-schema.org/draft/2020-12/schema"


def study_schema() -> dict[str, Any]:
    """Return the schema of a study file, JSON Schema draft 2020-12.

    It has every table with its keys, types, bounds and defaults, and the names that a
    key may have: catalogues, designs, types, constraints and optimisers. Conditions
    between keys are checked only when the study is read.
    """
    schema = Study.model_json_schema()
    properties, tables = schema["properties"], schema["$defs"]
    properties["plant"] |= _sources(PLANTS)
    for table in (properties, tables["BesideTable"]["properties"]):
        table["controller"] |= _sources(CONTROLLERS, design=DESIGNS)
    properties["constraints"] = {
        "type": "object",
        "description": "Limits by the names of their figures.",
        "properties": {name: _limit(name) for name in CONSTRAINTS},
        "additionalProperties": False,
    }
    _choice(tables["ParetoTable"], "constraint", CONSTRAINTS)
    _choice(tables["OptimiserTable"], "method", (*METHODS, GAUSS_NEWTON))
    return {"$schema": DRAFT} | schema


def _sources(catalog: Iterable[str], **named: Iterable[str]) -> dict[str, Any]:
    """Return the schema of a table with one source."""
    names = {"catalog": catalog, "type": kinds(), **named}
    enums = {key: {"enum": sorted(each)} for key, each in names.items()}
    return {"properties": {"file": {"type": "string"}, **enums}}


def _limit(name: str) -> dict[str, Any]:
    """Return the schema of a limit: a number between its bounds, or ``OFF``."""
    kind = CONSTRAINTS[name]
    number = {"type": "number", "exclusiveMinimum": kind.above}
    if math.isfinite(kind.below):
        number["exclusiveMaximum"] = kind.below
    found = {
        "anyOf": [number, {"const": OFF}],
        "description": f"{kind.sense}, in {kind.unit}",
    }
    return found if kind.default is None else found | {"default": kind.default}


def _choice(table: dict[str, Any], key: str, names: Iterable[str]) -> None:
    table["properties"][key]["enum"] = list(names)
