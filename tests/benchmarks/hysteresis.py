"""Speed of hysteresis models relative to C: a run, and a gradient by all parameters.

    python tests/benchmarks/hysteresis.py --json hysteresis.json

There are 64 lanes of 20 000 samples on one core, each with its own parameters and
input; both engines are timed in turn. The result is the mean square of the output of
each lane. The gradient is exact in piezojax (in reverse mode, or in forward mode if
that is faster: `mode` in the rows). In C it is by one-sided differences, a run for each
parameter and one more. A bar is the largest allowed `ratio_to_c`.

A model is measured if it is in `--model help`, or in OTHERS here, and if hysteresis.c
has a C function of its name; without one it is listed as having no reference in C.
"""

import argparse
import ctypes
import json
import math
import statistics
import sys
import time
from pathlib import Path

import throughput  # first: it prevents threads of libraries  # isort: skip
import engines
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import piezojax
from piezojax.core.paths import parameters, replace
from piezojax.core.recipe import Extent
from piezojax.core.registry import parts

BAR = 2.0
BARS = {"preisach": 5.0}
"""Largest ratio to C of models with another bar than BAR."""

EXTENT = Extent(
    low=0.0,
    high=100.0,
    first=(0.0, 0.0),
    slope=0.12,
    centre=0.0,
    span=12.0,
    dt=5e-5,
    duration=1.0,
)
"""The stage: 0.12 um/V over 100 V."""

DIFFERENCE = 1e-6
"""Step of the differences in C, as a share of a parameter's usual size."""

FEW = 12
"""Largest number of parameters for which both modes are timed."""

OTHERS = {
    # A force over a displacement, with the numbers of volts and um.
    "bouc_wen": lambda: piezojax.hysteresis.BoucWen(
        alpha=0.12, beta_gamma=0.012, beta_delta=-0.008, nu=1.3
    ),
    "duhem": lambda: piezojax.hysteresis.Duhem(
        reversible=[[0.08, 1e-4, -1e-6]],
        irreversible=[[1e-3, 7.7e-3, 1e-5, -1e-7], [-0.0487]],
    ),
    "normalised_bouc_wen": lambda: piezojax.hysteresis.NormalisedBoucWen(
        k_x=0.14, k_w=-1.5, rho=0.03, sigma=0.8, n=1.5
    ),
    "bashash_jalili": lambda: piezojax.hysteresis.BashashJalili(
        lower_input=-10.0,
        lower_output=-1.0,
        upper_input=120.0,
        upper_output=12.0,
        rising_alpha=-0.4,
        rising_tau=0.02,
        falling_alpha=-0.3,
        falling_tau=0.03,
    ),
}
"""Models timed with other numbers than the first guess of a fit: no term is
zero."""

MODELS = [name for name, kind in parts().items() if kind.part.place == "hysteresis"]
MODELS += [name for name in OTHERS if name not in MODELS]


def has_c_reference(name):
    """Return whether hysteresis.c has the model, with or without a compiler here."""
    source = Path(__file__).with_name("hysteresis.c").read_text(encoding="utf-8")
    return f"MODEL({name}," in source


class MeanSquare(piezojax.Metric):
    """Metric: mean square of the output."""

    samples: int = eqx.field(static=True)

    def init(self):
        return jnp.zeros(())

    def update(self, total, index, output):
        return total + output**2

    def result(self, total):
        return total / self.samples


class Problem:
    """A model, parameters [lanes, n] of usual size [n], inputs [lanes, steps].

    A number with size 0 is not a parameter and has no gradient.
    """

    def __init__(self, name, lanes, steps, seed=0):
        rng = np.random.default_rng(seed)
        bounds = {}
        if name in OTHERS:
            self.system = OTHERS[name]()
        else:
            self.system, bounds, *_ = parts()[name].recipe(EXTENT)
        self.name = name
        leaves = {path: np.asarray(v) for path, v in parameters(self.system).items()}
        self.shapes = {path: leaf.shape for path, leaf in leaves.items()}
        nominal = np.concatenate([leaf.ravel() for leaf in leaves.values()])
        sizes = [_size(bounds.get(path), leaf) for path, leaf in leaves.items()]
        self.sizes = np.concatenate(sizes)
        spread = rng.uniform(-0.1, 0.1, (lanes, len(nominal)))
        self.parameters = nominal + spread * self.sizes
        time_s = EXTENT.dt * np.arange(steps)
        hertz = np.linspace(5.0, 50.0, lanes)[:, None]
        fade = np.linspace(1.0, 0.3, steps)
        self.inputs = 50.0 * (1.0 - fade * np.cos(2 * np.pi * hertz * time_s))

    def lane(self, values, input, segment):
        """Return the mean square of the output of one lane."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes.values()])
        pieces = jnp.split(values, ends[:-1])
        system = replace(
            self.system,
            {
                path: piece.reshape(shape)
                for (path, shape), piece in zip(
                    self.shapes.items(), pieces, strict=True
                )
            },
        )
        before = getattr(system, "rest_input", 0.0)
        metric = MeanSquare(len(input))
        return piezojax.simulate(
            system, input, system.init(before), metric=metric, segment=segment
        )[1]


def _size(bounds, leaf):
    """Return the usual size of each number in a leaf; if it is 0, from its bounds."""
    if leaf.ndim:
        return np.abs(leaf).ravel()
    reach = 1.0 if bounds is None else bounds.upper - bounds.lower
    return np.array([abs(leaf) if leaf else 0.01 * reach], dtype=float)


def modes(what, count):
    """Return the modes of piezojax for a task, the usually fastest first."""
    if what == "forward":
        return ["run"]
    return ["forward", "reverse"] if count <= FEW else ["reverse"]


class PiezojaxEngine:
    """Engine in piezojax: all lanes in one program."""

    name = "piezojax"

    def __init__(self, problem, mode):
        steps = problem.inputs.shape[1]
        segment = steps if mode != "reverse" else piezojax.core.rollout.SEGMENT
        lane = lambda values, input: problem.lane(values, input, segment)  # noqa: E731
        function = {"run": lane, "forward": jax.jacfwd(lane), "reverse": jax.grad(lane)}
        # A plain loop reads inputs with time first, segments read whole lanes.
        axis = 1 if segment == steps else 0
        inputs = problem.inputs.T if axis else problem.inputs
        self._arguments = jnp.array(problem.parameters), jnp.array(inputs)
        begin = time.perf_counter()
        mapped = jax.vmap(function[mode], in_axes=(0, axis))
        self._compiled = jax.jit(mapped).lower(*self._arguments).compile()
        self.compile_s = time.perf_counter() - begin

    def run(self):
        return np.asarray(self._compiled(*self._arguments))


def _library():
    """Return the C functions, with the vector width of XLA if gcc supports it."""
    try:
        return engines.c_library("hysteresis.c", "-mprefer-vector-width=512")
    except engines.UnavailableError:
        return engines.c_library("hysteresis.c")


class CEngine:
    """Engine in C, hysteresis.c; UnavailableError without gcc or the functions."""

    name = "c"

    def __init__(self, problem, what):
        library, self.compile_s = _library()
        function = problem.name + ("_gradient" if what == "gradient" else "")
        if not hasattr(library, function):
            raise engines.UnavailableError(f"hysteresis.c has no {function}")
        width = library.width()
        self._lanes, steps = problem.inputs.shape
        arrays = [engines.blocks(problem.parameters, width)]
        shape = (-(-self._lanes // width), width)
        if what == "gradient":
            steps_of = np.broadcast_to(
                DIFFERENCE * problem.sizes, problem.parameters.shape
            )
            arrays.append(engines.blocks(steps_of, width))
            shape = (shape[0], len(problem.sizes), width)
        arrays.append(engines.blocks(problem.inputs, width))
        self._result = engines.aligned(*shape)
        self._arrays = [*arrays, self._result]
        pointer = ctypes.POINTER(ctypes.c_double)
        self._pointers = [array.ctypes.data_as(pointer) for array in self._arrays]
        self._steps, self._call = steps, getattr(library, function)
        self._call.argtypes = [ctypes.c_int] * 2 + [pointer] * len(self._arrays)
        self._call.restype = None

    def run(self):
        self._call(self._lanes, self._steps, *self._pointers)
        lanes_first = np.moveaxis(self._result, -1, 1)
        return lanes_first.reshape(-1, *self._result.shape[1:-1])[: self._lanes].copy()


def measure(problem, what, repeats):
    """Return the rows of C and piezojax, timed in turn."""
    found = [("run" if what == "forward" else "differences", CEngine(problem, what))]
    found += [
        (mode, PiezojaxEngine(problem, mode))
        for mode in modes(what, len(problem.sizes))
    ]
    calls = [
        max(1, math.ceil(throughput.SHORTEST_SAMPLE_S / throughput.seconds_of(e.run)))
        for _, e in found
    ]
    samples = [[] for _ in found]
    for _ in range(repeats):
        for (_, engine), count, taken in zip(found, calls, samples, strict=True):
            taken.append(throughput.seconds_of(engine.run, count))
    medians = [statistics.median(taken) for taken in samples]
    return [
        {
            "what": what,
            "model": problem.name,
            "parameters": len(problem.sizes),
            "engine": engine.name,
            "mode": mode,
            "lanes": problem.inputs.shape[0],
            "steps": problem.inputs.shape[1],
            "seconds_median": median,
            "ratio_to_c": median / medians[0],
            "bar": BARS.get(problem.name, BAR),
            "compile_s": engine.compile_s,
        }
        for (mode, engine), median in zip(found, medians, strict=True)
    ]


def within(rows):
    """Return whether the best mode of each model and task meets its bar."""
    best = {}
    for row in rows:
        if row["engine"] == "piezojax":
            key = row["model"], row["what"]
            ratio = row["ratio_to_c"] / row["bar"]
            best[key] = min(best.get(key, math.inf), ratio)
    return {key: ratio <= 1.0 for key, ratio in best.items()}


def table(rows):
    shown = Table(title=f"{rows[0]['lanes']} lanes, one core")
    for column in ("model", "what", "engine", "mode"):
        shown.add_column(column, no_wrap=True)
    for column in ("parameters", "ns a lane-step", "x C", "bar"):
        shown.add_column(column, justify="right")
    for row in rows:
        each = 1e9 * row["seconds_median"] / row["lanes"] / row["steps"]
        own = row["engine"] == "piezojax"
        shown.add_row(
            row["model"],
            row["what"],
            row["engine"],
            row["mode"],
            str(row["parameters"]),
            f"{each:.2f}",
            f"{row['ratio_to_c']:.2f}",
            f"{row['bar']:g}" if own else "",
        )
    return shown


def parse(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--lanes", type=throughput.positive_int, default=64)
    parser.add_argument("--steps", type=throughput.positive_int, default=20000)
    parser.add_argument("--repeats", type=throughput.positive_int, default=5)
    names = throughput.names_among(MODELS, "model")
    parser.add_argument("--models", type=names, default=MODELS)
    options = parser.parse_args(arguments)
    if not options.json.absolute().parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    return options


def main(arguments=None):
    options = parse(arguments)
    throughput.pin_to_one_core()
    console, rows = Console(width=None if sys.stdout.isatty() else 120), []
    for name in options.models:
        if not has_c_reference(name):
            console.print(f"{name}: no reference in C")
            continue
        problem = Problem(name, options.lanes, options.steps)
        for what in ("forward", "gradient"):
            try:
                rows += measure(problem, what, options.repeats)
            except engines.UnavailableError as reason:
                console.print(f"skipped: {name}, {what}: {reason}", style="yellow")
    if not rows:
        console.print("no model could be timed", style="red")
        return 1
    result = {"rows": rows, "versions": throughput.versions()}
    options.json.write_text(json.dumps(result, indent=2) + "\n")
    console.print(table(rows))
    for (name, what), kept in within(rows).items():
        if not kept:
            console.print(f"{name}, {what}: above its bar", style="red")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
