"""Export of the catalogue and of all models that are fitted, compiled and tested.

    python tests/benchmarks/exports.py [--precision float] [--models]

Each controller and plant of the catalogue, or with --models each model that
``identify`` fits, is exported as C; ``make test`` replays its golden vectors, 20 000
samples of a simulation with noise and saturation. The table has the number of lines of
the source, and the largest difference as a share of the largest output, or the reason
why the System is refused. clang, cppcheck and an emulated Cortex-M4 check each
source too, where they are installed; what they complain of is printed. Exits with 1 if
a test fails.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from export_models import MODELS
from rich.console import Console
from rich.table import Table

import piezojax as pj
from piezojax.catalog import CONTROLLERS, PLANTS
from piezojax.core.axes import Packed
from piezojax.exporting.c_export import write_c
from piezojax.exporting.slots import Interface
from piezojax.scalar import NotScalarError

# The tests are not installed.
sys.path.append(str(Path(__file__).resolve().parents[1]))
from c_tools import TOOLS, missing

SAMPLES = 20_000

LIMITS = {"p753": (-20.0, 120.0), "p558": (-50.0, 50.0), "mirror": (-5.0, 5.0)}
RANGES = {"p753": (0.0, 10.0), "p558": (-9.0, 9.0), "mirror": (-1.0, 1.0)}
"""Limits of the voltage and of the references by the stage in a name."""

CHECKS = {name: check for name, (_, check) in TOOLS.items() if not missing(name)}
"""The checks that this machine has, by the name of their tool."""


def tested(make, name, precision):
    """Return lines and relative difference of an export, and complaints by tool."""
    stage, axes = name.partition("_")[0], 1 if name.startswith("p753") else 3
    about = pj.About(judged=["not here"], reference_ranges=[RANGES[stage]] * axes)
    limits = [LIMITS[stage]] * axes
    options = {"precision": precision, "samples": SAMPLES}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "c"
        pj.export(make(), out, about=about, limits=limits, **options)
        return replayed(out, "controller" if name in CONTROLLERS else "plant")


def tested_model(make, _, precision):
    """Return the same of a model, whose input has ramps and noise, V."""
    draw = np.random.default_rng(0)
    corners = draw.uniform(0.0, 100.0, SAMPLES // 50)
    ramps = np.interp(np.arange(SAMPLES), np.arange(0, SAMPLES, 50), corners)
    voltage = jnp.asarray(ramps + 0.01 * draw.standard_normal(SAMPLES))
    system = make()
    if isinstance(system, Packed):
        voltage = (voltage,)
    first = jax.tree.map(lambda x: x[0], voltage)
    with tempfile.TemporaryDirectory() as folder:
        out, interface = Path(folder) / "c", Interface(first, first)
        write_c(system, interface, voltage, out, "plant", pj.About(), precision)
        return replayed(out, "plant")


def replayed(out, name):
    """Return lines and difference of the export in ``out``, and complaints by tool."""
    done = subprocess.run(
        ["make", "-s", "test"], cwd=out, capture_output=True, text=True
    )
    found = re.findall(r"difference (\S+), largest value (\S+),", done.stdout)
    shares = [float(a) / float(b.rstrip(",")) for a, b in found]
    lines = (out / f"{name}.c").read_text().count("\n")
    complaints = {"make test": done.stdout + done.stderr if done.returncode else ""}
    complaints |= {tool: check(out, name) for tool, check in CHECKS.items()}
    return lines, max(shares, default=float("nan")), complaints


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--precision", default="double")
    parser.add_argument("--models", action="store_true")
    chosen = parser.parse_args()
    precision = chosen.precision
    test = tested_model if chosen.models else tested
    systems = MODELS if chosen.models else CONTROLLERS | PLANTS
    console = Console(width=None if sys.stdout.isatty() else 120)
    table = Table(title=f"exports in {precision}")
    for head in ("System", "lines", "difference", "make test", *CHECKS):
        table.add_column(head, justify="left" if head == "System" else "right")
    passed = failed = 0
    for name, make in systems.items():
        try:
            lines, share, complaints = test(make, name, precision)
        except NotScalarError as error:
            table.add_row(name, "", "", f"refused: {error}")
            continue
        wrong = any(complaints.values())
        passed, failed = passed + (not wrong), failed + wrong
        verdicts = ("FAILED" if text else "passed" for text in complaints.values())
        table.add_row(name, str(lines), f"{share:.1e}", *verdicts)
        for tool, text in complaints.items():
            if text:
                console.print(f"{name}, {tool}: {text}", markup=False)
    console.print(table)
    console.print(f"{passed} passed, {failed} failed")
    for tool in TOOLS.keys() - CHECKS.keys():
        console.print(f"not run, for lack of {', '.join(missing(tool))}: {tool}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
