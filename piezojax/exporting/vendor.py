"""Parameter file of a vendor's controller, compared with a saved file."""

import csv
import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..control import E727, NV200, Stabilizer
from ..core.about import About, commented
from ..core.files import fresh_folder, write_bytes, write_text
from ..core.system import System
from .device_file import DeviceFile, Value
from .e727_file import E727_FILE
from .nv200_file import NV200_FILE
from .stabilizer_file import STABILIZER_FILE

FILES: dict[type[System], DeviceFile] = {
    E727: E727_FILE,
    NV200: NV200_FILE,
    Stabilizer: STABILIZER_FILE,
}
"""File formats of devices, by class of the controller."""


def device_values(system: System, before: Path | None = None) -> list[Value]:
    """Return the values of a device, with those of its saved file ``before``.

    Raises ValueError for a System without a vendor's file, a value out of the range of
    the device, and a saved file of another kind.
    """
    return _values(system, _saved(system, before)[1])


def _values(system: System, saved: Mapping[str, str]) -> list[Value]:
    return [
        value._replace(saved=saved.get(value.parameter, ""))
        for value in _file_of(system).values(_rounded(system))
    ]


def write_vendor(
    system: System, folder: Path, name: str, about: About, before: Path | None = None
) -> list[Path]:
    """Write the file of a device and a table to the new ``folder``; return the paths.

    The saved file ``before`` is copied beside them. Raises ValueError for a ``folder``
    in use, and in the cases of ``device_values``.
    """
    file, (content, saved) = _file_of(system), _saved(system, before)
    values = _values(system, saved)
    head = about.origin(f"Parameters of {type(system).__name__}")
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows([Value._fields, *values])
    texts = {
        f"{name}{file.suffix}": commented([*head, *file.notes(_rounded(system), saved)])
        + file.body(values, content),
        f"{name}_parameters.csv": commented(head) + table.getvalue(),
    }
    folder = fresh_folder(folder)
    for each, text in texts.items():
        write_text(folder / each, text)
    paths = [folder / each for each in texts]
    if before is not None:
        paths.append(folder / f"{before.name}.backup")
        write_bytes(paths[-1], before.read_bytes())
    return paths


def _file_of(system: System) -> DeviceFile:
    kind = type(system)
    if kind not in FILES:
        known = ", ".join(sorted(each.__name__ for each in FILES))
        raise ValueError(f"{kind.__name__} has no file of a vendor; {known} have one")
    return FILES[kind]


def _rounded(system: Any) -> Any:
    """Return a device with rounded parameters, which its constructor checks."""
    return dataclasses.replace(system).typed()


def _saved(system: System, before: Path | None) -> tuple[str, dict[str, str]]:
    """Return text, and values by key, of a saved file; both are empty without one."""
    if before is None:
        return "", {}
    try:
        text = before.read_text(encoding="utf-8-sig")
        return text, _file_of(system).read(text)
    except ValueError as error:
        raise ValueError(f"{before}: {error}") from None
