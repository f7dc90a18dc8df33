"""Readers of lab file formats: columns of numbers by name.

Each reader imports the library that it needs, so that a file of one format does not
need the libraries of the others.
"""

import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from .columns import Column, Columns, ContentError, decoded, parsed, table
from .mat_elements import check_elements
from .steps import stated_step


def read_columns(path: Path) -> Columns:
    """Read the columns of the file ``path``; its suffix gives its format (FORMATS).

    Scalars and text are skipped. A matrix ``u`` becomes ``u[0]``, ``u[1]``, ..., with
    time along its longer side; a field of a structure ``s`` becomes ``s.field``. Raises
    ValueError for a file that is missing, broken or of an unknown format, or if the
    package that reads the format is missing.
    """
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise ValueError(
            f"record {path}: its suffix {kind!r} is unknown; "
            f"it must be one of {', '.join(FORMATS)}"
        )
    form = FORMATS[kind]
    try:
        with open(path, "rb") as file:
            columns = form.read(file)
        if not columns:
            raise ContentError("there is no column of numbers in it")
    except ContentError as error:
        raise ValueError(f"{path.name}: {error}") from None
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{path.name}: reading {kind} needs the package {error.name}: "
            "pip install 'piezojax[lab]'"
        ) from None
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise ValueError(f"record {path}: {error.strerror}") from None
        # A library may raise any exception on a broken file.
        raise ValueError(
            f"record {path} cannot be read: it is not {form.content}"
        ) from error
    return columns


def _delimited(file: BinaryIO) -> Columns:
    text = decoded(file.read())
    if text.startswith(_LVM_HEAD) and _LVM_END in text:
        return _lvm_columns(text)
    return parsed(text)


def _npz(file: BinaryIO) -> Columns:
    with np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    step = stated_step(arrays)
    return _merged(_spread(name, values, dt=step) for name, values in arrays.items())


_MATLAB_UNITS = {"Frequency": "FrequencyUnit", "ResponseData": "ResponseUnit"}
"""Variables of a frequency response, and those with their units."""


def _mat(file: BinaryIO) -> Columns:
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    if matfile_version(file)[0] == 2:  # version 7.3: HDF5 behind a text header
        return _hdf5(file, separator=".")
    check_elements(file.read())
    file.seek(0)
    arrays = {n: v for n, v in loadmat(file).items() if not n.startswith("__")}
    step = stated_step(arrays)
    units = {name: _text(arrays.get(text)) for name, text in _MATLAB_UNITS.items()}
    return _merged(
        _spread(name, values, units.get(name), step) for name, values in arrays.items()
    )


def _hdf5(file: BinaryIO, separator: str = "/") -> Columns:
    import h5py

    found = []

    def visit(path, item):
        # MATLAB stores text and empty matrices as numbers, and its own tables under #.
        attributes = item.attrs
        text = "MATLAB_empty" in attributes or attributes.get("MATLAB_class") == b"char"
        if isinstance(item, h5py.Dataset) and not text and not path.startswith("#"):
            unit = _text(attributes.get("units", attributes.get("unit")))
            name, step = path.replace("/", separator), _hdf5_step(item)
            found.append(_spread(name, item[()], unit, step))

    with h5py.File(file, "r") as tree:
        tree.visititems(visit)
    return _merged(found)


def _hdf5_step(item: Any) -> float | None:
    """Return the sample time of a data set: its own, or that of the nearest group."""
    import h5py

    step = stated_step(item.attrs)
    while step is None and item.name != "/":
        item = item.parent
        scalars = {
            name: inner[()]
            for name, inner in item.items()
            if isinstance(inner, h5py.Dataset) and inner.size == 1
        }
        step = stated_step(scalars | dict(item.attrs))
    return step


def _tdms(file: BinaryIO) -> Columns:
    from nptdms import TdmsFile
    from nptdms.log import log_manager

    # The library logs the content of a broken file, pages of bytes included.
    log_manager.set_level(logging.CRITICAL)
    content = TdmsFile.read(file)
    if content.file_status.incomplete_final_segment:
        raise ContentError("the file is cut short")
    return _prefixed(
        {
            group.name: _merged(
                _spread(
                    channel.name,
                    channel[:],
                    _text(channel.properties.get("unit_string")),
                    _step(channel.properties.get("wf_increment"), channel.name),
                )
                for channel in group.channels()
            )
            for group in content.groups()
        }
    )


_LVM_HEAD, _LVM_END = "LabVIEW Measurement", "***End_of_Header***"


def _lvm(file: BinaryIO) -> Columns:
    return _lvm_columns(decoded(file.read()))


def _lvm_columns(text: str) -> Columns:
    # `lvm_read.read` would write a pickle beside the file and load it later.
    from lvm_read import read_str

    content = read_str(text)
    first = 0 if content.get("X_Columns") == "No" else -1
    return _prefixed(
        {str(i): _segment(content[i], first=first) for i in range(content["Segments"])}
    )


def _segment(segment: dict[str, Any], first: int) -> Columns:
    """Return the columns of an LVM segment; its header starts with column ``first``."""
    names = segment["Channel names"]
    columns = {}
    for j, (name, values) in enumerate(zip(names, segment["data"].T, strict=False)):
        unit, dt = (
            dict(enumerate(segment.get(key, ()), start=-first)).get(j)
            for key in ("Y_Unit_Label", "Delta_X")
        )
        if names.count(name) > 1:  # each channel may have its own X_Value
            name = f"{name}[{names[:j].count(name)}]"
        if name != "Comment":
            columns[name] = Column(values, unit or None, dt if dt and dt > 0 else None)
    return columns


def _xlsx(file: BinaryIO) -> Columns:
    from openpyxl import load_workbook

    book = load_workbook(file, read_only=True, data_only=True)
    rows = book.worksheets[0].iter_rows(values_only=True)
    return table(
        [["" if cell is None else str(cell).strip() for cell in row] for row in rows]
    )


class _Format(NamedTuple):
    content: str
    read: Callable[[BinaryIO], Columns]


_TEXT = _Format("a text table", _delimited)
_HDF5 = _Format("an HDF5 file of plain arrays", _hdf5)

FORMATS = {
    ".csv": _TEXT,
    ".txt": _TEXT,
    ".dat": _TEXT,
    ".npz": _Format("an NPZ archive of plain arrays", _npz),
    ".mat": _Format("a MATLAB file of plain arrays", _mat),
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".tdms": _Format("a TDMS file", _tdms),
    ".lvm": _Format("a LabVIEW measurement file", _lvm),
    ".xlsx": _Format("an Excel workbook", _xlsx),
}
"""File formats by suffix; of a workbook the first sheet is read."""


def _spread(
    name: str, values: Any, unit: str | None = None, dt: float | None = None
) -> Columns:
    """Return the columns in an array, a matrix, a structure or a cell array."""
    values = np.asarray(values)
    if values.dtype.names:
        parts = {f"{name}.{field}": values[field] for field in values.dtype.names}
    elif values.dtype.kind == "O":
        arrays = [part for part in values.flat if isinstance(part, np.ndarray)]
        parts = {name: arrays[0]} if len(arrays) == 1 else _numbered(name, arrays)
    else:
        values = values.squeeze()
        if values.size < 2 or values.ndim > 2 or values.dtype.kind in "SU":
            return {}
        if values.ndim == 1:
            return {name: Column(values, unit, dt)}
        parts = _numbered(name, max(values, values.T, key=len).T)
    return _merged(_spread(part, inner, unit, dt) for part, inner in parts.items())


def _numbered(name: str, parts: Iterable[np.ndarray]) -> dict[str, np.ndarray]:
    return {f"{name}[{i}]": part for i, part in enumerate(parts)}


def _merged(parts: Iterable[Columns]) -> Columns:
    return {name: column for part in parts for name, column in part.items()}


def _prefixed(groups: dict[str, Columns]) -> Columns:
    """Return columns as ``group/name``, or as ``name`` if there is a single group."""
    groups = {group: columns for group, columns in groups.items() if columns}
    if len(groups) == 1:
        return next(iter(groups.values()))
    return {
        f"{group}/{name}": column
        for group, columns in groups.items()
        for name, column in columns.items()
    }


def _step(value: Any, name: str) -> float | None:
    """Return the time step in s of channel ``name``, or None if the file has none."""
    try:
        step = float(value or 0.0)
    except (TypeError, ValueError):
        step = np.nan
    if not (np.isfinite(step) and step >= 0.0):
        raise ContentError(
            f"the time step of {name!r} is {value!r}; it must be a number above 0"
        )
    return step or None


def _text(value: Any) -> str | None:
    """Return a property of a file if it is text, as text or bytes, else None."""
    value = np.asarray(value).flat[0] if np.size(value) == 1 else None
    value = value.decode(errors="replace") if isinstance(value, bytes) else value
    return str(value) if isinstance(value, str) else None
