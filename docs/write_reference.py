"""Write the reference of study files and that of the commands.

The first is written from the schema of a study, the second from the commands.
"""

import inspect
import json
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import tomli_w

from piezojax.study import study_schema
from piezojax.study.json_schema import UNIT

DOCS = Path(__file__).parent

INTRODUCTION = """\
# Study reference

A study is a TOML file with the keys and tables below; other keys are errors. `tuning/`
has whole studies, and [goals](goals.md), [robust gains](robust.md) and the other how-to
pages explain them. An editor [completes and checks](goals.md#a-study-in-an-editor) a
study with the JSON schema that `python -m piezojax.tune --schema` prints;
`python docs/write_reference.py` writes this page from the same schema.

- A key is required unless a default is given. With the default "none" it may be left
  out.
- "By axis" is one value for all axes, or a list with one value for each axis.
- The unit "um or urad" is that of the axis, um on a stage with one axis. Values without
  a unit are pure numbers or have the unit that the text names.
- The path of a file is relative to the study.

A small study:
"""

SOURCES = """\
The table has one of these keys:

| key | value |
|---|---|
| `catalog` | {catalog} |
| `file` | a file with a saved System; `accept_unsafe = true` beside it accepts a file \
that was written with an alarm |
| `type` | the name of a class, with its fields beside it \
([reference](reference/index.md)) |
"""

FITTED = """\
| `record` | files with measured signals; the keys are those of \
[a plant from records](#a-plant-from-records) |
| `response` | a file with a frequency response; the keys are those of \
[a plant from a response](#a-plant-from-a-response) |
"""

DESIGNED = "| `design` | a controller designed for the plant of the study: {} |\n"

LIMITS = """\
Each limit holds for every plant and reference of the objective; [goals](goals.md)
defines the figures. The value `"off"` switches a limit off.

"""

HEADINGS = {
    "RecordPlant": "### A plant from records",
    "ResponsePlant": "### A plant from a response",
}


def study_page() -> str:
    """Return the reference of study files."""
    schema = study_schema()
    properties = schema["properties"]
    own = {key: each for key, each in properties.items() if not _is_table(each)}
    parts = [INTRODUCTION, _example(_ordered(schema))]
    parts += ["## Keys outside tables\n", _keys(schema, own)]
    places: dict[str, list[str]] = {}
    _collect(places, properties, schema["$defs"], "")
    for name, found in places.items():
        if name in properties:
            parts += _special(name, properties[name])
        else:
            parts += _table(name, found, schema)
    return "\n".join(parts)


def _collect(
    places: dict[str, list[str]],
    properties: dict[str, Any],
    tables: dict[str, Any],
    outer: str,
) -> None:
    """Add the places of all tables below ``properties``, by name, in their order."""
    for key, each in properties.items():
        place, names = f"{outer}{key}", _references(each)
        if key in ("plant", "controller", "constraints"):
            places.setdefault(key, []).append(place)
        for name in names:
            inner = ".PATH" if key == "parameters" else ".NAME"
            named = isinstance(each.get("additionalProperties"), dict)
            places.setdefault(name, []).append(place + inner * named)
            _collect(places, tables[name]["properties"], tables, f"{place}.")


def _references(each: dict[str, Any]) -> list[str]:
    """Return the names of the tables that a key may hold."""
    values = each.get("additionalProperties")
    parts = [each, *each.get("anyOf", ()), values if isinstance(values, dict) else {}]
    return [part["$ref"].rsplit("/", 1)[1] for part in parts if "$ref" in part]


def _is_table(each: dict[str, Any]) -> bool:
    return bool(_references(each)) or each.get("type") == "object"


def _table(name: str, places: list[str], schema: dict[str, Any]) -> Iterator[str]:
    """Yield the section of the table ``name``, which stands at ``places``."""
    table = schema["$defs"][name]
    headings = ", ".join(f"`[{place}]`" for place in places)
    yield HEADINGS.get(name, f"## {headings}") + "\n"
    yield _prose(table["description"], "\n\n") + "\n"
    yield _keys(table, table["properties"])
    keys, example = places[0].split("."), _ordered(table)
    for key in reversed(keys):
        key = key.replace("NAME", "my_name").replace("PATH", "controller.cutoff")
        example = {key: example}
    yield _example(example)


def _special(key: str, each: dict[str, Any]) -> Iterator[str]:
    """Yield the section of a table that has no fixed keys."""
    yield f"## `[{key}]`\n"
    yield _prose(each["description"]) + "\n"
    if key == "constraints":
        yield _limits(each["properties"])
        yield _example({key: each["examples"][0]})
        return
    (sources,) = (
        part["properties"]
        for part in (each, *each.get("anyOf", ()))
        if "catalog" in part.get("properties", {})
    )
    text = SOURCES.format(catalog=_names(sources["catalog"]["enum"]))
    if key == "plant":
        yield text + FITTED
        yield _example({key: {"catalog": "p753_stage"}})
    else:
        yield text + DESIGNED.format(_names(sources["design"]["enum"]))
        pid = {"type": "PID", "proportional": 0.5, "integral": 3000.0, "dt": 5e-5}
        yield _example({key: pid})


def _limits(limits: dict[str, Any]) -> str:
    return LIMITS + _keys({}, limits)


def _keys(table: dict[str, Any], properties: dict[str, Any]) -> str:
    """Return the Markdown table of the keys of a table."""
    rows = [
        "| key | type | unit | default | bounds | meaning |",
        "|---|---|---|---|---|---|",
    ]
    required = table.get("required", ())
    for key, each in properties.items():
        if key == "records":
            continue  # another name of ``record``
        unit = each.get("unit", "")
        meaning = each["description"].removesuffix(UNIT.format(unit))
        default = "required" if key in (*required, "record") else _default(each)
        cells = [f"`{key}`", _type(each), unit, default, _bounds(each), _prose(meaning)]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows) + "\n"


def _kinds(each: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the schemas of which a value matches one."""
    parts = [each] if "type" in each else each.get("anyOf", [each])
    return [part for part in parts if part.get("type") != "null"]


def _type(each: dict[str, Any]) -> str:
    """Return the type of a value in words."""
    kinds = _kinds(each)
    if _references(each):
        return "tables by name" if "additionalProperties" in each else "table"
    if len(kinds) > 1:
        one = " or ".join(_type(kind) for kind in kinds if "items" not in kind)
        listed = ", by axis" if one == "number" else ", or a list"
        return one + (listed if "items" in kinds[-1] else "")
    (kind,) = kinds
    if "const" in kind:
        return f'`"{kind["const"]}"`'
    if "enum" in kind:
        return _names(kind["enum"])
    match kind.get("type"):
        case "array" if "prefixItems" in kind:
            return f"pair: {_type(kind['prefixItems'][0])}"
        case "array":
            return f"list: {_type(kind['items'])}"
        case "object":
            values = kind["additionalProperties"]
            return "table" if values is True else f"table: {_type(values)}"
        case "string":
            return "file" if kind.get("format") == "path" else "text"
        case "integer":
            return "whole number"
        case "boolean":
            return "true or false"
    return str(kind["type"])


SIGNS = {
    "exclusiveMinimum": ">",
    "minimum": "≥",
    "exclusiveMaximum": "<",
    "maximum": "≤",
}


def _bounds(each: dict[str, Any]) -> str:
    """Return the bounds of a number, or of the numbers and the length of a list."""
    kind = _kinds(each)[0]
    inner = kind.get("items", kind)
    found = [f"{sign} {inner[key]:g}" for key, sign in SIGNS.items() if key in inner]
    if "minItems" in kind and "prefixItems" not in kind:
        found.append(f"{kind['minItems']} or more entries")
    return ", ".join(found)


def _default(each: dict[str, Any]) -> str:
    default = each.get("default")
    if default in (None, []) or isinstance(default, dict):
        return "none"
    return f"`{json.dumps(default)}`"


def _names(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _prose(text: str, paragraph: str = " ") -> str:
    """Return ``text`` with one line to a paragraph, for a cell of a table."""
    lines = (" ".join(part.split()) for part in text.split("\n\n"))
    return paragraph.join(lines).replace("|", "\\|").replace("``", "`")


def _ordered(table: dict[str, Any]) -> dict[str, Any]:
    """Return the example of ``table`` with its keys in the order of the table."""
    (example,) = table["examples"]
    return {key: example[key] for key in table["properties"] if key in example}


def _example(data: dict[str, Any]) -> str:
    short = re.sub(r"\[\n\s+(.*?),\n\]", _on_one_line, tomli_w.dumps(data), flags=re.S)
    return f"```toml\n{short}```\n"


def _on_one_line(found: re.Match[str]) -> str:
    return f"[{' '.join(found[1].split())}]"


COMMANDS = (
    *("excite", "start", "identify", "validate", "tune", "export", "sweep"),
    *("trial", "retune", "learn", "watch", "emulate", "reproduce"),
)

VALUES = {
    "boolean": "",
    "<float float>": "two numbers",
    "path": "path",
    "text": "text",
    "float": "number",
    "float range": "number",
    "integer": "whole number",
    "integer range": "whole number",
}
"""Values of options by the name of their type; other names say what to type."""

COMMANDS_INTRODUCTION = """\
# Commands

`--help` prints the text and the options of each command;
`python docs/write_reference.py` writes this page from them. A command ends with one of
these statuses:

| status | meaning |
|---|---|
| 0 | finished; gains may be used |
| 1 | refused or failed, with one line that says why |
| 3 | finished with an alarm: the results are written and say why they are unsafe |
| 130, 143 | interrupted by Ctrl-C or SIGTERM; tuning keeps the best gains |
"""


def commands_page() -> str:
    """Return the reference of the commands."""
    return "\n".join([COMMANDS_INTRODUCTION, *map(_command, COMMANDS)])


def _command(name: str) -> str:
    main = import_module(f"piezojax.cli.{name}").main
    info = main.to_info_dict(click.Context(main))
    options = [each for each in info["params"] if each["param_type_name"] == "option"]
    arguments = [each for each in main.params if isinstance(each, click.Argument)]
    given = " ".join(map(_argument, arguments))
    parts = [
        f"## `python -m piezojax.{name}`\n",
        f"```text\npython -m piezojax.{name} {given} [OPTIONS]\n```\n".replace(
            "  ", " "
        ),
        _prose(inspect.cleandoc(info["help"]), "\n\n") + "\n",
        "| option | value | default | meaning |",
        "|---|---|---|---|",
        *(_option(each) for each in options if each["name"] != "_click_default_help"),
    ]
    return "\n".join(parts) + "\n"


def _argument(each: click.Argument) -> str:
    several = "..." if each.nargs == -1 else ""
    name = each.metavar or f"{each.name}{several}".upper()
    return name if each.required else f"[{name}]"


def _option(each: dict[str, Any]) -> str:
    """Return the row of an option."""
    kind, default = each["type"], each["default"]
    name = kind["name"]
    value = _names(kind["choices"]) if "choices" in kind else VALUES.get(name, name)
    if each["required"]:
        shown = "required"
    elif default in (None, ()) or each["is_flag"]:
        shown = ""
    else:
        shown = f"`{default}`"
    names = ", ".join(f"`{name}`" for name in each["opts"] + each["secondary_opts"])
    return f"| {names} | {value} | {shown} | {_prose(each['help'])} |"


PAGES = {"study.md": study_page, "reference/commands.md": commands_page}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (DOCS / name).write_text(page(), encoding="utf-8")
