"""Throughput of piezojax, C, numba, NumPy and the peers of peers.py on closed loops.

    python tests/benchmarks/throughput.py --json throughput.json

Each engine runs on one core, in turn with the others (A, B, A, B, ...), so that other
load affects all equally. Rows of the JSON file:

    seconds_median    median time of --steps steps of all lanes. Slow engines are timed
                      over fewer steps, given as `steps`, and the time is scaled.
    lane_steps_per_s  lanes * --steps / seconds_median
    ratio_to_c        seconds_median over that of one forward run in C of the same
                      lanes, for gradients too; null where gcc is missing
    extra_memory_mb   growth of resident memory during a run (10^6 bytes), inputs and
                      compiled code not counted; null where the system is not Linux

Compile times are separate, in `compile_s`. C is always timed. Engines that are not
installed are skipped; peers.py says how to install its own.
Every lane has its own reference and noise: 4096 lanes need about 6 GB of memory, and
with all peers 11 GB.
"""

import argparse
import ctypes
import gc
import importlib.metadata
import json
import math
import multiprocessing
import os
import platform
import statistics
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# before any library starts its threads
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import engines  # noqa: E402
import peers  # noqa: E402
from loop_three_dof import THREE_DOF_PID_SMC  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

LOOPS = {loop.name: loop for loop in (engines.DOB_PID_SMC, THREE_DOF_PID_SMC)}
WRITTEN = {
    each.name: each
    for each in (engines.CEngine, engines.NumbaEngine, engines.NumpyEngine)
} | peers.ENGINES
ENGINES = ("piezojax", *WRITTEN)
COMPILED_PER_SHAPE = ("piezojax", "torch", "jaxonomy")
SHORTEST_SAMPLE_S = 0.02  # shorter runs are repeated within one measurement
SLOW_BUDGET_S = 1.0  # about the longest run of an engine marked slow
TRIAL_STEPS = 200
SETTLED_S = 0.1
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h
KEPT_BY_HEAP = {M_TRIM_THRESHOLD: 0, M_MMAP_THRESHOLD: 16384}  # bytes


def positive_int(text):
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive whole number")
    return value


def int_list(text):
    return sorted({positive_int(part) for part in text.split(",") if part})


def names_among(known, kind):
    def names(text):
        found = [part for part in text.split(",") if part]
        for name in found:
            if name not in known:
                raise argparse.ArgumentTypeError(
                    f"no {kind} {name!r}; there are {', '.join(known)}"
                )
        return found

    return names


def parse(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--lanes", type=int_list, default=[1, 8, 64, 512, 4096])
    parser.add_argument("--gradient-lanes", type=int_list, default=[8, 64])
    parser.add_argument("--steps", type=positive_int, default=20000)
    parser.add_argument("--repeats", type=positive_int, default=5)
    engine_list, loop_list = names_among(ENGINES, "engine"), names_among(LOOPS, "loop")
    parser.add_argument("--engines", type=engine_list, default=list(ENGINES))
    parser.add_argument("--loops", type=loop_list, default=list(LOOPS))
    options = parser.parse_args(arguments)
    if options.steps < TRIAL_STEPS:
        parser.error(f"--steps: at least {TRIAL_STEPS}")
    if not options.json.absolute().parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    return options


def pin_to_one_core():
    """Restrict this process, its later threads and its children to one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        return 1
    return os.cpu_count()


def make_engine(name, what, loop):
    if name == "piezojax":
        from piezojax_engine import PiezojaxEngine

        return PiezojaxEngine(what, loop)
    return WRITTEN[name](loop)


def part(data, what, steps):
    """Return the inputs of an engine: first steps, and shared gains for gradients."""
    gains, reference, noise = data
    gains = gains[0] if what == "gradient" else gains
    return gains, reference[:, : steps + 1], noise[:, :steps]


def seconds_of(run, calls=1):
    begin = time.perf_counter()
    for _ in range(calls):
        run()
    return (time.perf_counter() - begin) / calls


def prepare(engine, data, what, steps):
    """Prepare for at most `steps` steps; return the number of steps."""
    if engine.slow:
        engine.prepare(*part(data, what, TRIAL_STEPS))
        each = seconds_of(engine.run) / TRIAL_STEPS
        steps = min(steps, max(TRIAL_STEPS, int(SLOW_BUDGET_S / each)))
    engine.prepare(*part(data, what, steps))
    return steps


def measure(loop, lanes, wanted, options, skip):
    """Time the given (what, engine) pairs for one number of lanes, in turn."""
    entries, data = [], loop.problem(lanes, options.steps)
    for what, name in wanted:
        try:
            engine = make_engine(name, what, loop)
            steps = prepare(engine, data, what, options.steps)
        except (engines.UnavailableError, NotImplementedError) as reason:
            skip(f"{name}, {what}, {loop.name}: {reason}")
            continue
        warm = seconds_of(engine.run)
        calls = max(1, math.ceil(SHORTEST_SAMPLE_S / warm))
        entries.append((what, name, engine, steps, calls, []))
    for _ in range(options.repeats):
        for _, _, engine, _, calls, samples in entries:
            samples.append(seconds_of(engine.run, calls))
    return [
        {
            "what": what,
            "loop": loop.name,
            "engine": name,
            "lanes": lanes,
            "steps": steps,
            "seconds_median": statistics.median(samples) * options.steps / steps,
            "compile_s": engine.compile_s,
        }
        for what, name, engine, steps, _, samples in entries
    ]


def memory_bytes(field):
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise OSError(f"no {field} in /proc/self/status")


def extra_memory_mb(loop_name, what, name, lanes, steps):
    """Return the extra memory of one run of an engine."""
    loop = LOOPS[loop_name]
    engine = make_engine(name, what, loop)
    engine.prepare(*part(loop.problem(lanes, steps), what, steps))
    return growth_of_memory_mb(engine.run)


def growth_of_memory_mb(run):
    """Return the peak growth of resident memory in one run of this new process.

    ru_maxrss does not serve: a child inherits the peak of its parent, and compiling
    raises it above that of the run. Instead the peak of the kernel is reset after a
    warm-up run, when freed memory, which a run would reuse, has been returned. The heap
    may keep some of it all the same, so the largest of several growths counts.
    """
    try:
        library = ctypes.CDLL(None)
        for limit, size in KEPT_BY_HEAP.items():
            library.mallopt(limit, size)
        return max(_growth(run, library) for _ in range(3)) / 1e6
    except (OSError, AttributeError, TypeError):
        return None


def _growth(run, library):
    run()
    gc.collect()
    time.sleep(SETTLED_S)  # other threads free memory shortly after the run
    library.malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    before = memory_bytes("VmRSS")
    run()
    return max(0, memory_bytes("VmHWM") - before)


def in_fresh_process(function, *arguments):
    # Spawned, because a fork would start with the memory of this process.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=spawn) as pool:
        return pool.submit(function, *arguments).result()


def versions():
    found = {"python": platform.python_version(), "machine": platform.machine()}
    packages = ("piezojax", "jax", "jaxlib", "numba", "numpy")
    for name in (*packages, *peers.ENGINES):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    try:
        number = subprocess.check_output(["gcc", "-dumpfullversion"], text=True)
        found["gcc"] = f"{number.strip()} {engines.c_flags()}"
    except (OSError, subprocess.CalledProcessError, engines.UnavailableError):
        found["gcc"] = None
    return found


def table(rows):
    shown = Table(title="one core")
    for column in ("loop", "what", "engine"):
        shown.add_column(column, no_wrap=True)
    for column in ("lanes", "ns a lane-step", "x C", "extra MB", "steps"):
        shown.add_column(column, justify="right")

    def number(value, digits):
        digits = 0 if value is not None and value >= 1000 else digits
        return "-" if value is None else f"{value:.{digits}f}"

    for row in rows:
        shown.add_row(
            row["loop"],
            row["what"],
            row["engine"],
            str(row["lanes"]),
            number(1e9 / row["lane_steps_per_s"], 2),
            number(row["ratio_to_c"], 2),
            number(row["extra_memory_mb"], 1),
            str(row["steps"]),
        )
    return shown


def compile_key(row):
    """Return the key of a compilation: per shape, or once (C and numba)."""
    if row["engine"] in COMPILED_PER_SHAPE:
        return f"{row['engine']} {row['loop']} {row['what']} {row['lanes']}"
    return f"{row['engine']} {row['loop']}"


def main(arguments=None):
    options = parse(arguments)
    threads = pin_to_one_core()
    if "piezojax" in options.engines:
        import piezojax  # noqa: F401  # sets flags of XLA before jaxonomy starts it
    console = Console()
    skipped = set()

    def skip(line):
        if line not in skipped:
            skipped.add(line)
            console.print(
                f"skipped: {line}", style="yellow", markup=False, soft_wrap=True
            )

    forward = ["c", *(name for name in options.engines if name != "c")]
    rows, compile_s = [], {}
    cases = [
        (LOOPS[name], lanes)
        for name in options.loops
        for lanes in sorted({*options.lanes, *options.gradient_lanes})
    ]
    for loop, lanes in cases:
        wanted = [("forward", name) for name in forward if lanes in options.lanes]
        if lanes in options.gradient_lanes and "piezojax" in options.engines:
            wanted = [*(wanted or [("forward", "c")]), ("gradient", "piezojax")]
        if not wanted:
            continue
        console.print(f"{loop.name}, {lanes} lanes", style="dim")
        measured = measure(loop, lanes, wanted, options, skip)
        gc.collect()
        yardstick = next(
            (row["seconds_median"] for row in measured if row["engine"] == "c"), None
        )
        for row in measured:
            seconds, compiled = row["seconds_median"], row.pop("compile_s")
            if compiled is not None:
                compile_s.setdefault(compile_key(row), compiled)
            row["threads"] = threads if row["engine"] == "piezojax" else 1
            row["lane_steps_per_s"] = lanes * options.steps / seconds
            row["ratio_to_c"] = seconds / yardstick if yardstick else None
            row["extra_memory_mb"] = in_fresh_process(
                extra_memory_mb,
                loop.name,
                row["what"],
                row["engine"],
                lanes,
                row["steps"],
            )
            rows.append(row)

    if not rows:
        console.print("no engine could be timed", style="red")
        return 1
    result = {"rows": rows, "compile_s": compile_s, "versions": versions()}
    options.json.write_text(json.dumps(result, indent=2) + "\n")
    console.print(table(rows))
    for key, seconds in compile_s.items():
        console.print(f"compile {key}: {seconds:.2f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
