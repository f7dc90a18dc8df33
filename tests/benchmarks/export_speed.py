"""Time of a step of exported controllers, one thread, beside that of ``simulate``.

    python tests/benchmarks/export_speed.py [NAME...]

Each controller of the catalogue is exported as C and steps a million times through its
golden vectors, in double and in float; ``simulate`` runs over the same inputs. The best
of five turns counts.

    python tests/benchmarks/export_speed.py --by-hand

The controller and the plant of loop.c, which is written by hand, are exported with the
same gains and step in a plain loop (export_loop.c). Both loops are compiled with the
same flags and run one lane over the same reference and noise; their RMS errors agree.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import engines
import jax
import numpy as np
import piezojax_engine
from rich.console import Console
from rich.table import Table

import piezojax as pj
from piezojax.catalog import CONTROLLERS
from piezojax.exporting import Driven, Seen

NAMES = (
    *("p753_pid", "p753_sliding_mode", "p753_inversion", "p753_disturbance_observer"),
    *("p753_kalman_disturbance_observer", "p753_mixed_sensitivity", "p753_adaptive_pi"),
)
TURNS, ROUNDS, SAMPLES = 5, 500, 2000
ABOUT = pj.About(judged=["not here"], reference_ranges=[(0.0, 10.0)])
LIMITS = (-20.0, 120.0)
HERE = Path(__file__).parent
FLAGS = (engines.GCC_FLAGS, "-O2 -ffp-contract=off", engines.GCC_FLAGS + " -flto")
STEPS = 100_000

PROGRAM = """\
#include <stdio.h>
#include <time.h>
#include "controller.h"

int main(void) {{
    static double rows[{samples}][4];
    double start[4], sum = 0.0;
    const controller_parameters parameters = controller_defaults();
    controller_state state;
    FILE *file = fopen("vectors.csv", "r");
    clock_t begin;
    int i, k;
    while ((i = getc(file)) == '#')
        if (fscanf(file, "%*[^\\n] ") == EOF) return 1;
    ungetc(i, file);
    for (i = 0; i < 4; i++)
        if (fscanf(file, i ? ",%lf" : "%lf", &start[i]) != 1) return 1;
    if (fscanf(file, " %*[^\\n]") < 0) return 1;
    for (k = 0; k < {samples}; k++)
        for (i = 0; i < 4; i++)
            if (fscanf(file, i ? ",%lf" : " %lf", &rows[k][i]) != 1) return 1;
    controller_init(&state, &parameters, start[0], start[1], start[2], start[3]);
    begin = clock();
    for (i = 0; i < {rounds}; i++)
        for (k = 0; k < {samples}; k++)
            sum += controller_step(&state, &parameters, rows[k][0], rows[k][1],
                                   rows[k][2]);
    printf("%.6g %g\\n",
           1e9 * (clock() - begin) / CLOCKS_PER_SEC / {samples} / {rounds}, sum);
    return 0;
}}
"""


def in_c(name, precision):
    """Return lines of the source, bytes of the state, and ns of a step in C."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "c"
        header, source, *_ = pj.export(
            CONTROLLERS[name](),
            folder,
            about=ABOUT,
            limits=[LIMITS],
            precision=precision,
        )
        program = folder / "speed.c"
        program.write_text(PROGRAM.format(samples=SAMPLES, rounds=ROUNDS))
        command = ["cc", "-std=c99", "-O2", "-ffp-contract=off", "-o", "speed"]
        subprocess.run([*command, program, source, "-lm"], cwd=folder, check=True)
        found = []
        for _ in range(TURNS):
            done = subprocess.run(["./speed"], cwd=folder, capture_output=True)
            found.append(float(done.stdout.split()[0]))
        fields = header.read_text().partition("_parameters;")[2]
        numbers = len(re.findall(r"^    \w+ \w+;", fields, re.MULTILINE))
        return source.read_text().count("\n"), numbers, min(found)


def in_jax(name):
    """Return ns of a step of ``simulate``, one loop."""
    system = Driven(CONTROLLERS[name](), pj.Saturation(*LIMITS))
    r = np.sin(np.arange(100_001) / 60.0)
    inputs = Seen(*(jax.numpy.asarray(x) for x in (r[:-1], r[1:], r[:-1])))
    at = jax.numpy.asarray(0.0)
    state = system.init(pj.Observation(at, at, at, at))
    run = jax.jit(lambda inputs: pj.simulate(system, inputs, state)[1].sum())
    times = []
    for _ in range(TURNS):
        begin = time.perf_counter()
        run(inputs).block_until_ready()
        times.append(time.perf_counter() - begin)
    return 1e9 * min(times) / 100_000


def beside_loop_c(flags):
    """Return ns a step of the exported loop and of loop.c, and their RMS errors, um."""
    gains, reference, noise = (rows[0] for rows in engines.problem(1, STEPS))
    loop = piezojax_engine.loop(gains)
    with tempfile.TemporaryDirectory() as scratch:
        parts = {"controller": loop.controller, "plant": loop.plant}
        for name, part in parts.items():
            limits = [LIMITS] if name == "controller" else None
            pj.export(part, Path(scratch) / name, about=ABOUT, limits=limits)
        sources = [
            *(Path(scratch) / name / f"{name}.c" for name in parts),
            *(HERE / name for name in ("export_loop.c", "loop.c")),
        ]
        folders = [f"-I{Path(scratch) / name}" for name in parts]
        command = ["gcc", *flags.split(), *folders, "-o", f"{scratch}/loop", *sources]
        subprocess.run([*command, "-lm"], check=True)
        data = np.concatenate([gains, reference, noise]).tobytes()
        done = subprocess.run(
            [f"{scratch}/loop", str(STEPS)], input=data, capture_output=True, check=True
        )
    return tuple(map(float, done.stdout.split()))


def by_hand():
    """Return a table of the exported loop beside loop.c."""
    table = Table(title="a step of controller and plant")
    for head in ("flags of gcc", "exported", "loop.c", "ratio", "RMS errors differ by"):
        table.add_column(head, justify="left" if head == "flags of gcc" else "right")
    for flags in FLAGS:
        exported, plain, rms, wanted = beside_loop_c(flags)
        times = f"{exported:.1f} ns", f"{plain:.1f} ns", f"{exported / plain:.2f}"
        table.add_row(flags, *times, f"{abs(rms / wanted - 1.0):.0e}")
    return table


def main():
    console = Console(width=None if sys.stdout.isatty() else 100)
    if sys.argv[1:] == ["--by-hand"]:
        console.print(by_hand())
        return
    table = Table(title="a step of a controller")
    for head in ("controller", "numbers of state", "C double", "C float", "simulate"):
        table.add_column(head, justify="left" if head == "controller" else "right")
    for name in sys.argv[1:] or NAMES:
        _, numbers, double = in_c(name, "double")
        single = in_c(name, "float")[2]
        times = (f"{ns:.0f} ns" for ns in (double, single, in_jax(name)))
        table.add_row(name, str(numbers), *times)
    console.print(table)


if __name__ == "__main__":
    main()
