"""Labelled netCDF file with all chunks of a sweep."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..core.files import atomic_replacement
from ..study.sweep_table import SENSITIVITY
from .plan import TRAJECTORIES
from .simulator import Simulator
from .store import RESULT, Store

LONG_NAMES = {
    "rms_error": "rms tracking error",
    "peak_error": "peak tracking error",
    "rms_effort": "rms voltage",
    "rms_slew": "rms change of the voltage per sample",
    "saturated": "share of saturated samples",
    "peak_voltage": "peak voltage",
    SENSITIVITY: "peak of the sensitivity",
    "displacement": "displacement",
    "voltage": "voltage",
    "followed": "reference",
}
"""Meaning of each variable."""

_DISPLACEMENTS = ("rms_error", "peak_error", "displacement", "followed")
_DIMENSIONLESS = ("saturated", SENSITIVITY)


def unit_of(name: str, axes: bool) -> str:
    """Return the unit of a variable; on a stage with ``axes`` each axis has its own."""
    if name in _DIMENSIONLESS:
        return "1"
    if axes:
        # The commands of a multi-axis stage are in the unit of the axis, too.
        return "that of the axis"
    return "um" if name in _DISPLACEMENTS else "V"


def boxes(
    shape: tuple[int, ...], start: int, stop: int
) -> Iterator[tuple[tuple[slice, ...], int, int]]:
    """Split the points ``start`` to ``stop`` of a grid, in C order, into boxes.

    Yields each box as slices, with its first point and the point after its last.
    """
    if not shape or start >= stop:
        return
    inner = math.prod(shape[1:])
    row, rest = divmod(start, inner)
    if rest or stop - start < inner:
        # The first part covers at most one row.
        end = min(stop, (row + 1) * inner)
        for box, a, b in boxes(shape[1:], rest, end - row * inner):
            yield (slice(row, row + 1), *box), a + row * inner, b + row * inner
        yield from boxes(shape, end, stop)
        return
    last = stop // inner
    whole = tuple(slice(0, size) for size in shape[1:])
    yield (slice(row, last), *whole), start, last * inner
    yield from boxes(shape, last * inner, stop)


class Merger:
    """Writer of the data set of a sweep.

    It writes chunk by chunk, so that its memory does not grow with the sweep.
    """

    def __init__(self, simulator: Simulator, store: Store):
        self._simulator, self._store = simulator, store
        plan, axes = simulator.plan, simulator.case.study.axes
        self._sampled = plan.method != "grid"
        names = ("sample",) if self._sampled else tuple(a.path for a in plan.axes)
        self.sizes = dict(zip(names, plan.shape, strict=True))
        self._points = names
        self.sizes["plant"] = len(simulator.plants)
        self.sizes["reference"] = len(simulator.references)
        if simulator.draws > 1:
            self.sizes["draw"] = simulator.draws
        if axes:
            self.sizes["axis"] = len(axes.names)
        times = simulator.times()
        if times is not None:
            self.sizes["time"] = times.size

    def merge(self) -> None:
        """Write the data set atomically.

        Raises DamagedError, and writes nothing, if chunks are damaged.
        """
        import h5netcdf

        store, damaged = self._store, []
        with atomic_replacement(store.folder / RESULT) as path:
            with h5netcdf.File(path, "w") as file:
                self._write_frame(file)
                for chunk in range(self._simulator.plan.chunks):
                    stored = store.read(chunk)
                    if stored is None:
                        damaged.append(chunk)
                    else:
                        self._write_chunk(file, chunk, stored[0])
            if damaged:
                raise DamagedError(damaged)

    def _write_chunk(
        self, file: Any, chunk: int, arrays: dict[str, np.ndarray]
    ) -> None:
        plan = self._simulator.plan
        start, stop = plan.span(chunk)
        for name, array in arrays.items():
            variable = file.variables[name]
            inner = variable.shape[len(plan.shape) :]
            for box, a, b in boxes(plan.shape, start, stop):
                size = tuple(part.stop - part.start for part in box)
                values = array[a - start : b - start].reshape(*size, *inner)
                variable[(*box, *(slice(0, n) for n in inner))] = values

    def _write_frame(self, file: Any) -> None:
        """Write the attributes, coordinates and references; create the variables."""
        simulator, study = self._simulator, self._simulator.case.study
        file.dimensions = self.sizes
        for key, value in {
            "title": study.title,
            "study": simulator.case.name,
            "study_json": json.dumps(self._store.identity["study"]),
            "versions": json.dumps(self._store.identity["versions"]),
            "fingerprint": self._store.fingerprint,
            "method": simulator.plan.method,
            "seed": study.seed,
            "rate_Hz": study.rate,
        }.items():
            file.attrs[key] = value
        self._write_coordinates(file)
        names = (*simulator.metrics, *(TRAJECTORIES if simulator.every else ()))
        for name in names:
            self._variable(file, name, self._dimensions(name))
        if simulator.every:
            followed = np.asarray(simulator.reference)[:: simulator.draws]
            followed = np.moveaxis(followed[:, :: simulator.every], 1, -1)
            dimensions = [n for n in ("reference", "axis", "time") if n in self.sizes]
            self._variable(file, "followed", dimensions)[...] = followed

    def _dimensions(self, name: str) -> list[str]:
        if name == SENSITIVITY:
            return [*self._points, "plant"]
        return [n for n in self.sizes if n != "time" or name in TRAJECTORIES]

    def _variable(self, file: Any, name: str, dimensions: list[str]) -> Any:
        variable = file.create_variable(name, dimensions, dtype="f8")
        variable.attrs["units"] = unit_of(name, "axis" in self.sizes)
        variable.attrs["long_name"] = LONG_NAMES[name]
        others = ["axis_unit"] if "axis" in dimensions else []
        if "sample" in dimensions:
            others += [axis.path for axis in self._simulator.plan.axes]
        if others:
            variable.attrs["coordinates"] = " ".join(others)
        return variable

    def _write_coordinates(self, file: Any) -> None:
        import h5py

        simulator, plan = self._simulator, self._simulator.plan
        text = h5py.string_dtype()
        labels = {
            "plant": list(simulator.plants),
            "reference": list(simulator.references),
        }
        if simulator.case.study.axes:
            labels["axis"] = list(simulator.case.study.axes.names)
        for name, values in labels.items():
            file.create_variable(
                name, (name,), dtype=text, data=np.array(values, dtype=object)
            )
        if simulator.case.study.axes:
            units = np.array(simulator.case.study.axes.units, dtype=object)
            file.create_variable("axis_unit", ("axis",), dtype=text, data=units)
        for name in ("sample", "draw"):
            if name in self.sizes:
                numbers = np.arange(self.sizes[name])
                file.create_variable(name, (name,), data=numbers)
        times = simulator.times()
        if times is not None:
            variable = file.create_variable("time", ("time",), data=times)
            variable.attrs["units"] = "s"
        for column, axis in enumerate(plan.axes):
            values, dimension = axis.values, axis.path
            if self._sampled:
                values = plan.values(0, plan.points)[:, column]
                dimension = "sample"
            variable = file.create_variable(axis.path, (dimension,), data=values)
            variable.attrs["units"] = axis.range.unit
            variable.attrs["scale"] = axis.range.scale


class DamagedError(Exception):
    """Some chunks are damaged and must be simulated again."""

    def __init__(self, chunks: list[int]):
        super().__init__(f"damaged chunks: {chunks}")
        self.chunks = chunks


def is_merged(folder: Path, fingerprint: str) -> bool:
    """Return whether ``folder`` holds the data set of the sweep ``fingerprint``."""
    import h5netcdf

    try:
        with h5netcdf.File(folder / RESULT, "r") as file:
            return file.attrs.get("fingerprint") == fingerprint
    except (OSError, KeyError, ValueError):
        return False
