"""Compiled controller in a simulated loop; plant and sensor are C in double."""

import ctypes
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.about import About
from ..core.profile import COMPILING_C, stage
from ..core.system import System
from ..scalar.memory import NotScalarError
from .c_project import CProject
from .c_templates import LOOP
from .fmu import FLAGS
from .slots import Interface

TURNS = 5
"""Number of timing runs; the fastest counts."""


class RunTrace(NamedTuple):
    """Runs and axis that show the tracking error under the reference ``name``.

    ``runs`` is a slice of the runs, and ``unit`` the unit of the axis, um or urad.
    """

    name: str
    unit: str
    runs: slice
    axis: int


class Runs(NamedTuple):
    """Plant, sensor and signals of the runs that judge a compiled controller.

    ``sense`` and ``move`` are the signals of ``sensor`` and ``plant``. For n axes, each
    signal has n columns. ``starts`` holds reference, next reference, reading, voltage
    (V) and displacement at rest. ``rows`` holds reference, next reference, noise of
    unit variance, disturbance of the displacement, and disturbance of the voltage (V).
    Other signals are in the units of the axes. Errors count from sample ``settle`` on.
    """

    plant: System
    sensor: System
    move: Interface
    sense: Interface
    starts: Float[np.ndarray, "runs columns"]
    rows: Float[np.ndarray, "runs samples columns"]
    traces: tuple[RunTrace, ...]
    settle: int


class Steps(NamedTuple):
    """Results of the runs of a compiled controller.

    ``displacements`` are in the units of the axes. ``ns`` is the time of a step in ns,
    and ``state_bytes`` the size of the controller's state in bytes.
    """

    displacements: Float[np.ndarray, "runs samples axes"]
    ns: float
    state_bytes: int


class CompiledLoop:
    """Feedback loop of ``runs``, for a controller in C in any precision.

    Raises ValueError without a C compiler, and for a plant or sensor that cannot be
    written in scalar operations.
    """

    def __init__(self, runs: Runs):
        compiler = shutil.which("cc")
        if compiler is None:
            raise ValueError("there is no C compiler (cc)")
        arrays = (np.ascontiguousarray(x, float) for x in (runs.starts, runs.rows))
        self.starts, self.rows = arrays
        self.compiler, about = compiler, About()
        try:
            self.plant = CProject(runs.plant, runs.move, "plant", about)
            self.sensor = CProject(runs.sensor, runs.sense, "sensor", about)
            self.around = {**self.plant.files(), **self.sensor.files()}
        except NotScalarError as error:
            raise ValueError(f"the stage cannot be compiled: {error}") from None

    def steps(self, code: CProject) -> Steps:
        """Run and time the controller ``code``, which must be named "controller"."""
        count, samples, _ = self.rows.shape
        axes = len(code.outputs)
        moved = np.empty((count, samples, axes))
        seen, took = np.empty((samples, 3 * axes)), []
        with tempfile.TemporaryDirectory() as scratch:
            library = self._library(code, Path(scratch))
            for run, start in enumerate(self.starts):
                signals = map(_pointer, (start, self.rows[run], seen, moved[run]))
                library.run(ctypes.c_long(samples), *signals)
            signals = [_pointer(self.starts[-1]), _pointer(seen)]
            for _ in range(TURNS):
                begin = time.perf_counter()
                library.replay(ctypes.c_long(samples), *signals)
                took.append(time.perf_counter() - begin)
            return Steps(moved, 1e9 * min(took) / samples, library.state_bytes())

    def _library(self, code: CProject, folder: Path) -> ctypes.CDLL:
        axes, real = len(code.outputs), code.precision.real

        def each(text: str, first: int = 0) -> list[str]:
            return [text.format(first * axes + i) for i in range(axes)]

        seen = [f"({real})seen[{i}]" for i in range(3 * axes)]
        added = zip(each("u[{}]"), each("row[{}]", 4), strict=True)
        pushed = [f"{voltage} + {more}" for voltage, more in added]
        loop = LOOP.format(
            axes=axes,
            begin=", ".join(f"({real})start[{i}]" for i in range(4 * axes)),
            voltage=", ".join(each("start[{}]", 3)),
            displacement=", ".join([*each("start[{}]", 4), *["0.0"] * axes]),
            sense=self.sensor.step_block(
                ["&sensor", "&of_sensor", *each("y[{}]"), *each("row[{}]", 2)],
                each("z[{}]"),
            ),
            control=code.step_block(["&state", "&parameters", *seen], each("u[{}]")),
            move=self.plant.step_block(["&plant", "&of_plant", *pushed], each("y[{}]")),
        )
        files = {"loop.c": loop, **code.files(), **self.around}
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        sources = [file for file in files if file.endswith(".c")]
        command = [self.compiler, *FLAGS, "-o", "loop.so", *sources, "-lm"]
        with stage(COMPILING_C):
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"{self.compiler} fails: {done.stderr.strip()}")
        return ctypes.CDLL(str(folder / "loop.so"))


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
