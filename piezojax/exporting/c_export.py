"""Export of a System as C99: header, source, golden vectors, and a test."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..core.about import About, commented
from ..core.files import fresh_folder, write_text
from ..core.rollout import simulate
from ..core.system import System
from .c_project import CProject
from .c_templates import MAKEFILE, TEST
from .slots import Interface

TOLERANCE = {"double": 1e-12, "float": 1e-3, "compensated": 1e-3}
"""Accepted difference from the golden vectors, as a share of their largest value."""

LOOSEST = 1e-10
"""Largest tolerance in double, for a System that amplifies rounding errors."""


def write_c(
    system: System,
    interface: Interface,
    inputs: Any,
    folder: Path,
    name: str,
    about: About,
    precision: str = "double",
) -> list[Path]:
    """Write ``system`` to the new ``folder`` as C99; return the paths of the files.

    ``name`` is the prefix of every name in the header. ``inputs`` is a pytree like
    ``interface.input`` whose leaves have a leading axis of samples. The simulated
    outputs for it are the golden vectors, which ``make test`` replays.
    Raises ValueError for a ``folder`` in use, a ``name`` that is no C identifier, an
    unknown ``precision``, and a System that cannot be written in scalar operations; the
    message names the operation.
    """
    code = CProject(system, interface, name, about, precision)
    _, outputs = simulate(code.system, inputs, code.state)
    tolerance = TOLERANCE[precision]
    if precision == "double":
        amplified = 2.0 * rounding_error(code, inputs, outputs)
        tolerance = min(max(tolerance, amplified), LOOSEST)
    files = {
        **code.files(),
        f"test_{name}.c": test_program(code, tolerance),
        "vectors.csv": vectors(code, inputs, outputs),
        "Makefile": commented(code.head()) + MAKEFILE.format(name=name),
    }
    folder = fresh_folder(folder)
    for file, text in files.items():
        write_text(folder / file, text)
    return [folder / file for file in files]


def rounding_error(code: CProject, inputs: Any, outputs: Any) -> float:
    """Return the change of ``outputs`` if the last bit of each parameter changes.

    Each parameter goes up or down at random. The result is the largest change, as a
    share of the largest value of its output: two correct programs may differ by it.
    """
    draw = np.random.default_rng(0)

    def changed(leaf: Any) -> Any:
        if not eqx.is_inexact_array(leaf):
            return leaf
        return leaf * (1.0 + np.spacing(1.0) * draw.choice([-1.0, 1.0], leaf.shape))

    system = jax.tree.map(changed, code.system)
    _, others = simulate(system, inputs, code.state)
    pairs = zip(jax.tree.leaves(outputs), jax.tree.leaves(others), strict=True)
    shares = [
        np.max(np.abs(a - b)) / largest
        for a, b in pairs
        if (largest := np.max(np.abs(a))) > 0.0
    ]
    return float(np.nan_to_num(max(shares, default=0.0)))


def vectors(code: CProject, inputs: Any, outputs: Any) -> str:
    """Return a simulation as CSV: start, column names, and a row for each sample.

    The lines before them begin with ``#`` and state the origin.
    """
    columns = [
        np.asarray(leaf).reshape(len(leaf))
        for tree in (inputs, outputs)
        for leaf in jax.tree.leaves(tree)
    ]
    names = [slot.name for slot in (*code.inputs, *code.outputs)]
    start = [float(leaf) for leaf in jax.tree.leaves(code.interface.start)]
    rows = np.column_stack(columns)
    return commented(code.head()) + "\n".join(
        [
            ",".join(repr(value) for value in start),
            ",".join(names),
            *(",".join(repr(float(v)) for v in row) for row in rows),
            "",
        ]
    )


def test_program(code: CProject, tolerance: float) -> str:
    """Return the C program that replays the vectors and compares the outputs."""
    starts, inputs, outputs = (
        len(part) for part in (code.starts, code.inputs, code.outputs)
    )
    real = code.precision.real
    begin = "".join(f", ({real})start[{i}]" for i in range(starts))
    given = [f"({real})row[{i}]" for i in range(inputs)]
    found = [f"found[{i}]" for i in range(outputs)]
    return TEST.format(
        origin=code.origin(),
        name=code.name,
        starts=starts,
        columns=inputs + outputs,
        inputs=inputs,
        outputs=outputs,
        output=code.output_variable,
        begin=begin,
        step=code.step_call(["&state", "&parameters", *given], found),
        tolerance=repr(tolerance),
    )
