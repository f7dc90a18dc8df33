"""Seeded corpus of mutated studies, models and records.

Case n of a seed is reproducible. Each starts from a valid file (a shipped
study, a controller or plant of the catalogue, a record in one of the formats) and has
one to four mutations of its keys, values, types, units, nesting, lines or bytes.
"""

import contextlib
import copy
import datetime
import io
import json
import re
import tomllib
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import h5py
import numpy as np
import tomli_w
from nptdms import ChannelObject, TdmsWriter
from openpyxl import Workbook
from scipy.io import savemat

from piezojax import study as studies
from piezojax.catalog import CONTROLLERS, PLANTS
from piezojax.core.serial import to_data

SAMPLES = 120

NUMBERS = (
    *(0, 1, -1, 2, 7, 64, 400, 10**9, 2**31, 2**63, 10**30, 10**400),
    *(0.0, -0.0, 0.5, 1.5, -2.5, 1e-300, 5e-324, 1e15, 1e300, -1e308),
    *(float("nan"), float("inf"), float("-inf")),
)
TEXTS = (
    *("", " ", "x", "0", "1e5", "nan", "true", "SIN1", "SIN1e400", "SW-3", "SIN0"),
    *(
        "Z:SIN5 Q:SIN3",
        "a" * 5000,
        "µm",
        "two\nlines",
        "tab\t",
        "../../etc",
        "/dev/zero",
    ),
    *("p753_stage", "Affine", "controller.*", "plant.0", "[", "\u0000", "\U0001f600"),
)
OTHERS = (
    *(True, False, [], {}, [[]], [1], [1.0, 2.0], ["x"], [[1.0], [2.0, 3.0]]),
    *({"type": "Affine"}, {"lower": 0.0}, [{"type": "Delay", "samples": 10**9}]),
    *(datetime.date(2020, 1, 1), datetime.time(1, 2, 3), {"": {"": 1}}),
)


@dataclass
class Case:
    """A file of one ``kind`` and, for a record, the options for reading it."""

    kind: str
    name: str
    content: bytes
    options: dict[str, Any] = field(default_factory=dict)


def case(seed: int, number: int) -> Case:
    """Return case ``number`` of the corpus ``seed``."""
    random = np.random.default_rng([seed, number])
    kinds = (_study_case, _study_case, _model_case, _record_case, _record_case)
    return kinds[number % len(kinds)](random)


def _pick(random: np.random.Generator, items: Any) -> Any:
    return items[int(random.integers(len(items)))]


# Studies and models: trees of tables


@cache
def study_trees() -> dict[str, dict[str, Any]]:
    """Return the shipped studies as tables, by name."""
    folder = studies.shipped().parent
    trees = {
        path.stem: tomllib.loads(path.read_text(encoding="utf-8"))
        for path in sorted(folder.rglob("*.toml"))
    }
    for tree in trees.values():
        if "controllers" in tree:  # one study of the comparison instead of all
            tree["rates"] = tree["rates"][:1]
            name, table = next(iter(tree["controllers"].items()))
            tree["controllers"] = {name: table}
    return trees


@cache
def _model_trees() -> dict[str, dict[str, Any]]:
    made = {**CONTROLLERS, **PLANTS}
    return {
        name: json.loads(json.dumps(to_data(make()))) for name, make in made.items()
    }


def _study_case(random: np.random.Generator) -> Case:
    name = _pick(random, sorted(study_trees()))
    tree = mutated(copy.deepcopy(study_trees()[name]), random)
    try:
        text = tomli_w.dumps(tree)
    except (TypeError, ValueError, AttributeError, RecursionError):
        text = tomli_w.dumps(study_trees()[name])
    content = text.encode("utf-8", "replace")
    if random.random() < 0.2:
        content = _spoilt(content, random)
    return Case("study", f"{name}.toml", content)


def _model_case(random: np.random.Generator) -> Case:
    name = _pick(random, sorted(_model_trees()))
    tree = mutated(copy.deepcopy(_model_trees()[name]), random)
    content = json.dumps(tree, default=str).encode("utf-8", "replace")
    if random.random() < 0.2:
        content = _spoilt(content, random)
    return Case("model", f"{name}.json", content)


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Return all (table or list, key) pairs of a tree."""
    found, waiting = [], [tree]
    while waiting:
        node = waiting.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node))
        for key in keys:
            found.append((node, key))
            if isinstance(node[key], dict | list):
                waiting.append(node[key])
    return found


def mutated(tree: dict[str, Any], random: np.random.Generator) -> dict[str, Any]:
    """Return ``tree`` after one to three mutations, which change it."""
    for _ in range(int(random.integers(1, 4))):
        places = _places(tree)
        if not places:
            break
        node, key = _pick(random, places)
        _pick(random, MUTATIONS)(node, key, random)
    return tree


def _another_value(node, key, random):
    pool = (NUMBERS, NUMBERS, TEXTS, OTHERS)[int(random.integers(4))]
    node[key] = copy.deepcopy(_pick(random, pool))


def _another_size(node, key, random):
    value = node[key]
    if isinstance(value, int | float) and not isinstance(value, bool):
        factor = 10.0 ** int(random.integers(-12, 13)) * _pick(random, (1, -1))
        with contextlib.suppress(OverflowError):  # an integer beyond every float
            node[key] = value * factor
    elif isinstance(value, str | list):
        node[key] = value * int(random.integers(0, 4))


def _without(node, key, random):
    del node[key]


def _another_key(node, key, random):
    if isinstance(node, dict):
        value = node.pop(key)
        changes = (str.upper, str.title, lambda k: k[:-1], lambda k: k + "s")
        more = (lambda k: f"{k}\n", lambda k: f"plant.{k}", lambda k: "µ" + k)
        node[_pick(random, (*changes, *more))(str(key))] = value


def _one_more(node, key, random):
    value = copy.deepcopy(_pick(random, (*NUMBERS, *TEXTS, *OTHERS)))
    if isinstance(node, dict):
        node[_pick(random, ("x", "type", "record", "file", "design", "", "dt"))] = value
    else:
        node.append(value)


def _wrapped(node, key, random):
    depth = int(_pick(random, (1, 1, 2, 70, 3000)))
    value = node[key]
    for _ in range(min(depth, 300)):
        value = [value] if random.random() < 0.5 else {"a": value}
    node[key] = value


def _swapped(node, key, random):
    keys = list(node) if isinstance(node, dict) else list(range(len(node)))
    other = _pick(random, keys)
    node[key], node[other] = node[other], node[key]


MUTATIONS: tuple[Callable[..., None], ...] = (
    *(_another_value, _another_value, _another_value, _another_size, _another_size),
    *(_without, _another_key, _one_more, _wrapped, _swapped),
)


# Records: text, binary formats, options


def _signals() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time = np.arange(SAMPLES) * 1e-3
    drive = 10.0 + 10.0 * np.sin(2.0 * np.pi * 30.0 * time)
    return time, drive, 0.1 * drive + 0.3 * np.sin(2.0 * np.pi * 90.0 * time)


def _text(separator: str, decimal: str, head: str, end: str = "") -> bytes:
    rows = (
        separator.join(f"{x:.6g}".replace(".", decimal) for x in row) + end
        for row in zip(*_signals(), strict=True)
    )
    return (head + "\n".join(rows) + "\n").encode()


def _excerpt() -> bytes:
    path = studies.shipped().parent / "data" / "micromanipulator.csv"
    return b"".join(path.read_bytes().splitlines(keepends=True)[:SAMPLES])


def _saved(save: Callable[[Any], None]) -> bytes:
    buffer = io.BytesIO()
    save(buffer)
    return buffer.getvalue()


def _mat(arrays: dict[str, Any]) -> bytes:
    content = _saved(lambda file: savemat(file, arrays))
    return b"MATLAB 5.0 MAT-file".ljust(124) + content[124:]  # without the date


def _hdf5(buffer: Any) -> None:
    time, drive, sensor = _signals()
    with h5py.File(buffer, "w") as file:
        file["t"], file["u"], file["stage/y"] = time, drive, sensor
        file["u"].attrs["unit"] = "V"
        file.attrs["fs"] = 1e3


def _tdms(buffer: Any) -> None:
    known = {"wf_increment": 1e-3, "unit_string": "V"}
    channels = [
        ChannelObject("a", name, values, known)
        for name, values in zip("tuy", _signals(), strict=True)
    ]
    with TdmsWriter(buffer) as writer:
        writer.write_segment(channels)


def _xlsx() -> bytes:
    book = Workbook()
    for row in (["t", "u", "y"], *zip(*(s.tolist() for s in _signals()), strict=True)):
        book.active.append(list(row))
    dated, undated = io.BytesIO(_saved(book.save)), io.BytesIO()
    with zipfile.ZipFile(dated) as old, zipfile.ZipFile(undated, "w") as new:
        for name in old.namelist():
            content = re.sub(rb"20\d\d-[-\d]+T[:\d]+Z", b"", old.read(name))
            new.writestr(zipfile.ZipInfo(name), content)
    return undated.getvalue()


_LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
    "X_Columns\tOne\n***End_of_Header***\t\n\t\nChannels\t2\t\t\nSamples\t120\t120\t\n"
    "X_Dimension\tTime\tTime\t\nDelta_X\t1.0E-3\t1.0E-3\t\n***End_of_Header***\t\t\t\n"
    "X_Value\tu\ty\tComment\n"
)
_TEKTRONIX = (
    "Model,MSO4034\nSample Interval,1e-3,,\nVertical Units,V,V\nTIME,CH1,CH2,\n"
)


@cache
def _records() -> dict[str, tuple[bytes, dict[str, Any]]]:
    arrays = dict(zip("tuy", _signals(), strict=True))
    columns = {"time": 0, "input": 1, "output": 2}
    named = {"time": "t", "input": "u", "output": "y"}
    return {
        "micromanipulator.csv": (_excerpt(), columns),
        "comma.csv": (_text(",", ".", "time_s,drive_V,sensor_um\n"), columns),
        "semicolon.txt": (_text(";", ",", "t;u;y\ns;V;um\n"), columns),
        "blank.dat": (_text(" ", ".", "# bench\n"), columns),
        "rigol.csv": (
            _text(",", ".", "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,0,1e-3\n"),
            {"input": 1, "output": 2},
        ),
        "keysight.csv": (
            _text(",", ".", "x-axis,1,2\nsecond,Volt,Volt\n"),
            columns,
        ),
        "tektronix.csv": (_text(",", ".", _TEKTRONIX, ","), columns),
        "labview.lvm": (_text("\t", ".", _LABVIEW), {"input": "u", "output": "y"}),
        "arrays.npz": (_saved(lambda f: np.savez(f, fs=1e3, **arrays)), named),
        "arrays.mat": (_mat(arrays | {"fs": 1e3}), named),
        "arrays.h5": (_saved(_hdf5), named | {"output": "stage/y"}),
        "arrays.tdms": (_saved(_tdms), named),
        "arrays.xlsx": (_xlsx(), named),
    }


OPTIONS = {
    "time": (None, 0, "0", "t", "nowhere", -1, 10**30, ""),
    "input": (0, 1, "u", "0,1", [0, 1], [], "", -1, 99, "µ"),
    "output": (2, 1, "y", "1,2", [1, 2], "", 99),
    "rate": (None, 1e3, 0.0, -1.0, 1e300, 1e-300, float("nan"), float("inf")),
    "period": (None, 0, -3, 2, 33, 119, 10**9),
    "resample": (None, 500.0, 1e4, 1e11, 1e300, 1e-9, 0.0, -1.0, float("nan")),
}


def _record_case(random: np.random.Generator) -> Case:
    name = _pick(random, sorted(_records()))
    content, options = _records()[name]
    options = dict(options)
    for _ in range(int(random.integers(0, 3))):
        key = _pick(random, sorted(OPTIONS))
        options[key] = _pick(random, OPTIONS[key])
    for _ in range(int(random.integers(0, 4))):
        text = name.endswith((".csv", ".txt", ".dat", ".lvm"))
        cells = text and random.random() < 0.7
        content = (_cells if cells else _spoilt)(content, random)
    if random.random() < 0.05:
        name = name.rsplit(".", 1)[0] + _pick(random, (".csv", ".mat", ".h5", ".x", ""))
    return Case("record", name, content, options)


CELLS = (
    *(
        "",
        "nan",
        "inf",
        "-inf",
        "1e999",
        "1e308",
        "-1e308",
        "1e-320",
        "x",
        "1,5",
        "1.5",
    ),
    *(
        "0x1f",
        "1_000",
        "--",
        "µ",
        "#",
        "%",
        '"',
        "'",
        "\u0000",
        "9" * 400,
        "TRUE",
        "[V]",
    ),
    *("OVER", "1 V", "Sample Interval", "Increment", "dt", "fs", "12:30:01", "\u22125"),
)


def _cells(content: bytes, random: np.random.Generator) -> bytes:
    """Return a text table with changed cells."""
    lines = content.decode("utf-8", "replace").split("\n")
    separator = next((s for s in ";\t, " if s in lines[-2]), ",") if lines[1:] else ","
    near = random.random() < 0.4  # the header
    row = int(random.integers(min(5, len(lines)) if near else len(lines)))
    cells = lines[row].split(separator)
    column = int(random.integers(len(cells)))
    match int(random.integers(6)):
        case 0 | 1:
            cells[column] = _pick(random, CELLS)
            lines[row] = separator.join(cells)
        case 2:  # a whole column
            value = _pick(random, CELLS)
            for i, line in enumerate(lines[2:], start=2):
                parts = line.split(separator)
                if column < len(parts):
                    parts[column] = value
                    lines[i] = separator.join(parts)
        case 3:
            lines[row : row + int(random.integers(1, 90))] = []
        case 4:
            lines.insert(
                row, _pick(random, (separator * 3, "Vertical Scale,2", *CELLS))
            )
        case 5:
            lines[row] = separator.join([*cells, *cells])
    return "\n".join(lines).encode("utf-8", "replace")


def _spoilt(content: bytes, random: np.random.Generator) -> bytes:
    """Change bytes, encoding or length of a file."""
    if not content:
        return b"\x00"
    start = int(random.integers(len(content)))
    length = int(random.integers(1, 64))
    match int(random.integers(7)):
        case 0:
            return content[:start]
        case 1:
            noise = random.bytes(length)
            return content[:start] + noise + content[start + length :]
        case 2:
            return content[:start] + content[start + length :]
        case 3:
            again = content[start : start + length] * int(random.integers(2, 50))
            return content[:start] + again + content[start:]
        case 4:
            codec = _pick(random, ("utf-16", "utf-8-sig", "utf-32"))
            return content.decode("latin-1").encode(codec)
        case 5:
            flipped = bytearray(content)
            for i in random.integers(len(content), size=8):
                flipped[i] ^= 1 << int(random.integers(8))
            return bytes(flipped)
        case _:
            return content + content
