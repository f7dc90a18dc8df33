"""Speed of the Preisach models relative to C.

    python tests/benchmarks/preisach.py --json preisach.json

The plain and the rate-dependent model run alone in float64 on one core: 64 lanes, each
with its own input, over 2000 steps. The result is the mean square of the output, and
its gradient by all weights (and the rate) in reverse mode. C (preisach.c) is the faster
of two programs; its gradient is in closed form, because the output is linear in the
weights. Runs alternate, so that other load affects all equally; times are medians.
ratio_to_c is the time divided by that of C for the same result.
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
from piezojax.core.paths import parameters, replace
from piezojax.core.rollout import Metric

GROUP = 8  # as in preisach.c
LOW, HIGH = -20.0, 120.0  # V
DT, PACE = 1e-4, 4e3  # s; V/s: half of the samples are faster


class MeanSquare(Metric):
    """Metric: mean square of the output, um^2."""

    def init(self):
        return jnp.zeros(()), jnp.zeros(())

    def update(self, total, index, output):
        return total[0] + output**2, total[1] + 1.0

    def result(self, total):
        return total[0] / total[1]


def problem(model, cells, lanes, steps, seed=0):
    """Return the model, and inputs (V) [lanes, steps]: growing sines."""
    rng = np.random.default_rng(seed)
    weights = [np.tril(rng.uniform(0.0, 0.2, (cells, cells))) for _ in range(2)]
    time = np.arange(steps) / steps
    rates = rng.uniform(3.0, 12.0, (lanes, 1))
    slow = piezojax.hysteresis.Preisach(weights[0], LOW, HIGH, start="saturated")
    models = {
        "preisach": slow,
        "rate_dependent": piezojax.hysteresis.RateDependentPreisach(
            slow, weights[1], PACE, DT
        ),
    }
    return models[model], 50.0 + 68.0 * time * np.sin(2.0 * np.pi * rates * time)


def by_c(name, model, inputs):
    """Return the function that runs the C function ``name`` for the mean squares.

    For a gradient it returns their sum and the gradient of it by path.
    """
    source = Path(__file__).with_name("preisach.c")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, "preisach.so")
        flags = ["-O3", "-march=native", "-shared", "-fPIC"]
        subprocess.run(["gcc", *flags, source, "-o", target, "-lm"], check=True)
        function = getattr(ctypes.CDLL(str(target)), name)
    known = parameters(model)
    densities = [path for path in known if path.endswith("weights")]
    cells, (lanes, steps) = len(known[densities[0]]), inputs.shape
    volts = (HIGH - LOW) / cells
    half_way = float(known.get("rate", PACE)) * DT / volts
    ends = np.cumsum(np.arange(cells, 0, -1))
    lines = [np.diag(known[path], -k) for path in densities for k in range(cells)]
    weights = np.concatenate(lines)
    groups = -(-lanes // GROUP)
    padded = np.resize((inputs - LOW) / volts, (groups * GROUP, steps))
    data = np.ascontiguousarray(padded.reshape(groups, GROUP, steps).swapaxes(1, 2))
    square = np.empty(groups * GROUP)
    slopes = np.empty((groups, weights.size + len(densities) - 1, GROUP))
    pointer = ctypes.POINTER(ctypes.c_double)
    at = [array.ctypes.data_as(pointer) for array in (weights, data, square, slopes)]
    before = (cells, groups, steps, at[0], ctypes.c_double(half_way))

    def run(_kept=(weights, data)):
        function(*before, *at[1:3])
        return square[:lanes] / steps

    def run_gradient(_kept=(weights, data)):
        function(*before, *at[1:])
        every = slopes.swapaxes(1, 2).reshape(-1, slopes.shape[1])[:lanes]
        total = every.sum(axis=0) / steps
        found = {}
        for i, path in enumerate(densities):
            own = np.split(total[i * ends[-1] : (i + 1) * ends[-1]], ends[:-1])
            found[path] = sum(np.diag(line, -k) for k, line in enumerate(own))
        if "rate" in known:
            found["rate"] = total[-1] * DT / volts
        return square[:lanes].sum() / steps, found

    return run_gradient if name.endswith("gradient") else run


def by_piezojax(model, inputs, *, gradient):
    """Return the function that runs the model, and the seconds of compiling."""
    signals = jnp.asarray(inputs)
    known = parameters(model)
    values = {
        path: value
        for path, value in known.items()
        if path.endswith(("weights", "rate"))
    }

    def squares(values, signals):
        with_values = replace(model, values)

        def lane(model, signal):
            options = {} if gradient else {"segment": signal.size}
            return piezojax.simulate(
                model, signal, model.init(LOW), metric=MeanSquare(), **options
            )[1]

        if not gradient:
            return jax.vmap(lane, (None, 1))(with_values, signals.T)
        # One copy per lane: gradients are then summed once, not in each step.
        many = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (len(signals), *x.shape)), with_values
        )
        return jnp.sum(jax.vmap(lane)(many, signals))

    function = jax.value_and_grad(squares) if gradient else squares
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(values, signals).compile()
    compile_s = time.perf_counter() - begin
    return lambda: jax.block_until_ready(compiled(values, signals)), compile_s


def timed(name, options):
    """Return the rows of one model, and the seconds of compiling."""
    model, inputs = problem(name, options.cells, options.lanes, options.steps)
    forward, forward_s = by_piezojax(model, inputs, gradient=False)
    gradient, gradient_s = by_piezojax(model, inputs, gradient=True)
    runs = {
        "C, ramps": by_c(f"{name}_ramps", model, inputs),
        "C, table": by_c(f"{name}_table", model, inputs),
        "C, gradient": by_c(f"{name}_gradient", model, inputs),
        "piezojax, forward": forward,
        "piezojax, gradient": gradient,
    }
    expected = runs["C, ramps"]()
    for engine in ("C, table", "piezojax, forward"):
        np.testing.assert_allclose(runs[engine](), expected, rtol=1e-9, err_msg=engine)
    (ours, slopes), (theirs, expected) = gradient(), runs["C, gradient"]()
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    for path, slope in expected.items():
        np.testing.assert_allclose(slopes[path], slope, rtol=1e-9, err_msg=path)
    seconds = {engine: [] for engine in runs}
    for _ in range(options.repeats):
        for engine, run in runs.items():
            begin = time.perf_counter()
            run()
            seconds[engine].append(time.perf_counter() - begin)
    medians = {engine: statistics.median(all) for engine, all in seconds.items()}
    forward_c = min(medians["C, ramps"], medians["C, table"])
    rows = [
        {
            "model": name,
            "engine": engine,
            "seconds_median": median,
            "ratio_to_c": median
            / (medians["C, gradient"] if engine.endswith("gradient") else forward_c),
        }
        for engine, median in medians.items()
    ]
    return rows, {"forward": forward_s, "gradient": gradient_s}


def main():
    """Check that all agree, time them in turn, and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--lanes", type=int, default=64)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    table = Table(
        title=f"{options.cells} x {options.cells} cells, {options.lanes} lanes, "
        f"{options.steps} steps"
    )
    for column in ("model", "engine", "seconds", "ns a lane and step", "x C"):
        table.add_column(column)
    all_rows, compiling = [], {}
    for name in ("preisach", "rate_dependent"):
        rows, compiling[name] = timed(name, options)
        all_rows += rows
        for row in rows:
            each = 1e9 * row["seconds_median"] / options.lanes / options.steps
            table.add_row(
                name,
                row["engine"],
                f"{row['seconds_median']:.4f}",
                f"{each:.1f}",
                f"{row['ratio_to_c']:.2f}",
            )
    Console().print(table)
    for name, seconds in compiling.items():
        Console().print(
            f"compiling {name}: {seconds['forward']:.1f} s forward, "
            f"{seconds['gradient']:.1f} s gradient"
        )
    found = {"rows": all_rows, "compile_s": compiling}
    options.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
