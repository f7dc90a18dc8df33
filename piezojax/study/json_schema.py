"""JSON schema of a study, with which editors complete and check its file."""

import math
from collections.abc import Iterable
from typing import Any

from ..analysis.constraints import CONSTRAINTS, OFF
from ..catalog import CONTROLLERS, PLANTS
from ..core.registry import kinds
from ..solve.optimisers import GAUSS_NEWTON, METHODS
from .designs import ALL_DESIGNS
from .plant_tables import RecordPlant, ResponsePlant
from .schema import Study
from .sweep_table import METRICS

DRAFT = "https://json-schema.org/draft/2020-12/schema"

UNIT = " Unit: {}."
"""End of the description of a key with a unit, for editors. The unit also stands under
``unit``, a keyword that validators ignore."""


def study_schema() -> dict[str, Any]:
    """Return the schema of a study file, JSON Schema draft 2020-12.

    It has every table with its keys, types, bounds and defaults, and the names that
    some keys take as values: catalogue entries, designs, types, constraints, metrics
    and optimisers. Conditions between keys are checked only when the study is read.
    """
    schema = Study.model_json_schema()
    properties, tables = schema["properties"], schema["$defs"]
    tables |= {
        kind.__name__: kind.model_json_schema() for kind in (RecordPlant, ResponsePlant)
    }
    _several_names(tables["RecordPlant"])
    properties["plant"] |= {
        "anyOf": [
            _source(PLANTS),
            {"$ref": "#/$defs/RecordPlant"},
            {"$ref": "#/$defs/ResponsePlant"},
        ]
    }
    for table in (properties, tables["BesideTable"]["properties"]):
        table["controller"] |= _source(CONTROLLERS, design=ALL_DESIGNS)
    properties["constraints"] = {
        "type": "object",
        "description": properties["constraints"]["description"],
        "properties": {name: _limit(name) for name in CONSTRAINTS},
        "additionalProperties": False,
        "examples": [{"sensitivity_peak": 1.6, "settling_time": 0.005}],
    }
    _choice(tables["ParetoTable"], "constraint", CONSTRAINTS)
    _choice(tables["OptimiserTable"], "method", (*METHODS, GAUSS_NEWTON))
    tables["SweepTable"]["properties"]["metrics"]["items"]["enum"] = list(METRICS)
    for table in (schema, *tables.values()):
        for each in table["properties"].values():
            if "unit" in each:
                each["description"] += UNIT.format(each["unit"])
    return {"$schema": DRAFT} | schema


def _source(catalog: Iterable[str], **named: Iterable[str]) -> dict[str, Any]:
    """Return the schema of a table with one source."""
    names = {"catalog": catalog, "type": kinds(), **named}
    enums = {key: {"enum": sorted(each)} for key, each in names.items()}
    sources = {"file": {"type": "string"}, **enums}
    return {
        "properties": sources,
        "anyOf": [{"required": [source]} for source in sources],
    }


def _several_names(record: dict[str, Any]) -> None:
    """Allow ``records`` as another name of ``record``, and a string for one file."""
    properties = record["properties"]
    for key in ("record", "check"):
        files = properties[key]
        types = {name: files.pop(name) for name in ("type", "items")}
        if "minItems" in files:
            types["minItems"] = files.pop("minItems")
        properties[key] = {"anyOf": [types["items"], types]} | files
    properties["records"] = properties["record"]
    del record["required"]
    record["anyOf"] = [{"required": ["record"]}, {"required": ["records"]}]


def _limit(name: str) -> dict[str, Any]:
    """Return the schema of a limit: a number between its bounds, or ``OFF``."""
    kind = CONSTRAINTS[name]
    number = {"type": "number", "exclusiveMinimum": kind.above}
    if math.isfinite(kind.below):
        number["exclusiveMaximum"] = kind.below
    found = {
        "anyOf": [number, {"const": OFF}],
        "description": f"{kind.meaning}, {kind.sense}.{UNIT.format(kind.unit)}",
        "unit": kind.unit,
    }
    return found if kind.default is None else found | {"default": kind.default}


def _choice(table: dict[str, Any], key: str, names: Iterable[str]) -> None:
    table["properties"][key]["enum"] = list(names)
