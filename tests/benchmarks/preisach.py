"""Speed of the Preisach model beside C.

    python tests/benchmarks/preisach.py --json preisach.json

The model by itself, float64, one core: 64 lanes, each with its own input, over 2000
steps; the mean square of the output, and its gradient by all weights in reverse mode.
C (preisach.c) is the faster of two ways to write it, and its gradient in closed form:
the output is linear in the weights. Runs take turns, so that a busy machine disturbs
all alike; medians. ratio_to_c is over C for the same figures.
"""

import argparse
import ctypes
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import piezojax
from piezojax.rollout import Metric

GROUP = 8  # as in preisach.c
LOW, HIGH = -20.0, 120.0  # V


class MeanSquare(Metric):
    """Of the output, um^2."""

    def init(self):
        return jnp.zeros(()), jnp.zeros(())

    def update(self, total, index, output):
        return total[0] + output**2, total[1] + 1.0

    def result(self, total):
        return total[0] / total[1]


def problem(cells, lanes, steps, seed=0):
    """Weights [cells, cells], um, and inputs [lanes, steps], V: sines that grow."""
    rng = np.random.default_rng(seed)
    weights = np.tril(rng.uniform(0.0, 0.2, (cells, cells)))
    time = np.arange(steps) / steps
    rates = rng.uniform(3.0, 12.0, (lanes, 1))
    return weights, 50.0 + 68.0 * time * np.sin(2.0 * np.pi * rates * time)


def by_c(name, weights, inputs):
    """What runs the C function ``name`` and returns the mean squares.

    Of a gradient: their sum, and its gradient [cells, cells].
    """
    source = Path(__file__).with_name("preisach.c")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, "preisach.so")
        flags = ["-O3", "-march=native", "-shared", "-fPIC"]
        subprocess.run(["gcc", *flags, source, "-o", target, "-lm"], check=True)
        function = getattr(ctypes.CDLL(str(target)), name)
    cells, (lanes, steps) = len(weights), inputs.shape
    lines = np.concatenate([np.diag(weights, -k) for k in range(cells)])
    x = (inputs - LOW) / (HIGH - LOW) * cells
    groups = -(-lanes // GROUP)
    padded = np.resize(x, (groups * GROUP, steps)).reshape(groups, GROUP, steps)
    data = np.ascontiguousarray(padded.swapaxes(1, 2))
    square = np.empty(groups * GROUP)
    pointer = ctypes.POINTER(ctypes.c_double)
    pointers = [array.ctypes.data_as(pointer) for array in (lines, data, square)]
    slopes = np.empty((groups, len(lines), GROUP))

    def run(_kept=(lines, data)):
        function(cells, groups, steps, *pointers)
        return square[:lanes] / steps

    def run_gradient(_kept=(lines, data)):
        function(cells, groups, steps, *pointers, slopes.ctypes.data_as(pointer))
        every = slopes.swapaxes(1, 2).reshape(-1, len(lines))[:lanes]
        total = every.sum(axis=0) / steps
        gradient = np.zeros((cells, cells))
        ends = np.cumsum(np.arange(cells, 0, -1))
        for k, line in enumerate(np.split(total, ends[:-1])):
            gradient += np.diag(line, -k)
        return square[:lanes].sum() / steps, gradient

    return run_gradient if name.endswith("gradient") else run


def by_piezojax(weights, inputs, *, gradient):
    """What runs the model, and the seconds of compiling."""
    signals = jnp.asarray(inputs)

    def squares(weights, signals):
        model = piezojax.Preisach(weights, LOW, HIGH, start="saturated")

        def lane(model, signal):
            options = {} if gradient else {"segment": signal.size}
            return piezojax.simulate(
                model, signal, model.init(LOW), metric=MeanSquare(), **options
            )[1]

        if not gradient:
            return jax.vmap(lane, (None, 1))(model, signals.T)
        # A copy for each lane: their gradients are then summed once, not in each step.
        many = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (len(signals), *x.shape)), model
        )
        return jnp.sum(jax.vmap(lane)(many, signals))

    function = jax.value_and_grad(squares) if gradient else squares
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(jnp.asarray(weights), signals).compile()
    compile_s = time.perf_counter() - begin
    weights = jnp.asarray(weights)
    return lambda: jax.block_until_ready(compiled(weights, signals)), compile_s


def main():
    """Check that all agree, time them in turns, print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--lanes", type=int, default=64)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=7)
    chosen = parser.parse_args()
    weights, inputs = problem(chosen.cells, chosen.lanes, chosen.steps)
    forward, forward_s = by_piezojax(weights, inputs, gradient=False)
    gradient, gradient_s = by_piezojax(weights, inputs, gradient=True)
    runs = {
        "C, ramps": by_c("preisach_ramps", weights, inputs),
        "C, table": by_c("preisach_table", weights, inputs),
        "C, gradient": by_c("preisach_gradient", weights, inputs),
        "piezojax, forward": forward,
        "piezojax, gradient": gradient,
    }
    expected = runs["C, ramps"]()
    for name in ("C, table", "piezojax, forward"):
        np.testing.assert_allclose(runs[name](), expected, rtol=1e-9, err_msg=name)
    for ours, theirs in zip(gradient(), runs["C, gradient"](), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    seconds = {name: [] for name in runs}
    for _ in range(chosen.repeats):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    medians = {name: statistics.median(all) for name, all in seconds.items()}
    forward_c = min(medians["C, ramps"], medians["C, table"])
    yardstick = {
        name: medians["C, gradient"] if name.endswith("gradient") else forward_c
        for name in runs
    }
    table = Table(
        title=f"{chosen.cells} x {chosen.cells} cells, {chosen.lanes} lanes, "
        f"{chosen.steps} steps"
    )
    for column in ("engine", "seconds", "ns a lane and step", "x C"):
        table.add_column(column)
    rows = []
    for name, median in medians.items():
        each = 1e9 * median / chosen.lanes / chosen.steps
        rows.append(
            {
                "engine": name,
                "seconds_median": median,
                "ratio_to_c": median / yardstick[name],
            }
        )
        ratio = f"{median / yardstick[name]:.2f}"
        table.add_row(name, f"{median:.4f}", f"{each:.1f}", ratio)
    Console().print(table)
    compiling = {"forward": forward_s, "gradient": gradient_s}
    Console().print(
        f"compiling: {forward_s:.1f} s forward, {gradient_s:.1f} s gradient"
    )
    found = {"rows": rows, "compile_s": compiling}
    chosen.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
