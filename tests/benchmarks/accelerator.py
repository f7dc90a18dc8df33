"""Throughput of many lanes on a GPU: one kernel for all steps, against XLA and C.

    python tests/benchmarks/accelerator.py --json accelerator.json

Simulates the two loops of throughput.py in float64, every lane with its own gains and
all lanes with the same reference and noise, as in a sweep. Rows of the JSON file:

    engine            gpu: one kernel for all steps; loop: jax.vmap of the loop over
                      time, by XLA; c: 64 lanes on one core of the host, each with
                      signals of its own
    seconds           shortest of --repeats runs of --steps steps of all lanes
    ns_per_lane_step  seconds / (lanes * steps), in ns
    compile_s         tracing and compiling
    largest_deviation largest relative deviation of a figure of a lane from the engine
                      loop, over 2000 steps of up to 1000 lanes

Without a GPU the engines loop and c run.
"""

import argparse
import importlib.metadata
import json
import time
from pathlib import Path

import engines
import numpy as np
from loop_three_dof import THREE_DOF_PID_SMC
from piezojax_engine import LOOPS
from rich.console import Console
from rich.table import Table

PROBLEMS = {loop.name: loop for loop in (engines.DOB_PID_SMC, THREE_DOF_PID_SMC)}
CHECKED = (1000, 2000)  # lanes and steps
HOST_LANES = 64


def parse():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--lanes", default="1000,10000,100000,1000000")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=3)
    return parser.parse_args()


def compiled(problem, lanes, steps, engine):
    """Return a function that simulates and waits, and the seconds of compiling."""
    import jax
    import jax.numpy as jnp

    from piezojax.core.axes import PerAxisMetric
    from piezojax.core.feedback import LoopInput
    from piezojax.core.metrics import Tracking
    from piezojax.engines import metered

    loop_of = LOOPS[problem.name]()
    gains, reference, noise = problem.problem(min(lanes, CHECKED[0]), steps)
    gains = np.tile(gains, (-(-lanes // len(gains)), 1))[:lanes]
    metric, start = Tracking(start=steps // 2), 0.0
    signals = reference[0, 1:], noise[0]
    if noise.ndim > 2:
        axes = noise.shape[2]
        metric, start = PerAxisMetric(metric, axes), (0.0,) * axes
        signals = (tuple(jnp.array(x[:, i]) for i in range(axes)) for x in signals)
    inputs = LoopInput(*(jax.tree.map(jnp.array, x) for x in signals))

    def lane(gains, inputs):
        loop = loop_of(gains)
        return metered(loop, inputs, loop.init(start), metric, engine=engine)[0]

    begin = time.perf_counter()
    lanes_of = jax.jit(jax.vmap(lane, in_axes=(0, None)))
    program = lanes_of.lower(jnp.array(gains), inputs).compile()
    seconds, arguments = time.perf_counter() - begin, (jnp.array(gains), inputs)
    return lambda: jax.block_until_ready(program(*arguments)), seconds


def deviation(problem):
    """Return the largest relative deviation between the engines gpu and loop."""
    import jax

    one, other = (
        jax.tree.map(np.asarray, compiled(problem, *CHECKED, engine)[0]())
        for engine in ("gpu", "loop")
    )
    each = jax.tree.map(
        lambda a, b: np.abs(a - b) / np.maximum(np.abs(b), 1e-9), one, other
    )
    return max(float(np.max(leaf)) for leaf in jax.tree.leaves(each))


def shortest(run, repeats):
    run()
    found = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        found.append(time.perf_counter() - begin)
    return min(found)


def host_seconds(problem, steps, repeats):
    """Return the seconds of C on one core of the host, or None without gcc."""
    engine = engines.CEngine(problem)
    try:
        engine.prepare(*problem.problem(HOST_LANES, steps))
    except engines.UnavailableError:
        return None
    return shortest(engine.run, repeats)


def main():
    options = parse()
    import jax

    console, rows = Console(), []
    device = jax.devices()[0]
    names = ("gpu", "loop") if device.platform == "gpu" else ("loop",)

    def add(loop, engine, lanes, seconds, compile_s=None):
        each = 1e9 * seconds / (lanes * options.steps)
        rows.append(
            {
                "loop": loop,
                "engine": engine,
                "lanes": lanes,
                "steps": options.steps,
                "seconds": seconds,
                "ns_per_lane_step": each,
                "compile_s": compile_s,
            }
        )
        console.print(f"{loop} {engine} {lanes} lanes: {each:.4f} ns", style="dim")

    result = {
        "device": f"{device.device_kind}, {device.platform}",
        "versions": {n: importlib.metadata.version(n) for n in ("jax", "jaxlib")},
        "largest_deviation": {},
        "rows": rows,
    }
    for name, problem in PROBLEMS.items():
        seconds = host_seconds(problem, options.steps, options.repeats)
        if seconds is not None:
            add(name, "c", HOST_LANES, seconds)
        if "gpu" in names:
            result["largest_deviation"][name] = deviation(problem)
        for lanes in map(int, options.lanes.split(",")):
            for engine in names:
                run, compile_s = compiled(problem, lanes, options.steps, engine)
                add(name, engine, lanes, shortest(run, options.repeats), compile_s)
                options.json.write_text(json.dumps(result, indent=2) + "\n")
    table = Table(title=result["device"])
    for column in (
        "loop",
        "engine",
        "lanes",
        "ns a lane-step",
        "lane-steps/s",
        "compile s",
    ):
        table.add_column(column, no_wrap=True)
    for row in rows:
        each, compile_s = row["ns_per_lane_step"], row["compile_s"]
        table.add_row(
            row["loop"],
            row["engine"],
            str(row["lanes"]),
            f"{each:.4f}",
            f"{1e9 / each:.2e}",
            "" if compile_s is None else f"{compile_s:.1f}",
        )
    console.print(table)
    for name, found in result["largest_deviation"].items():
        console.print(f"{name}: gpu deviates from loop by at most {found:.1e}")


if __name__ == "__main__":
    main()
