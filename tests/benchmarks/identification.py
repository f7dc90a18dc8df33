"""Fit of ten parameters to 20 000 samples from 16 starts: piezojax and SciPy.

    python tests/benchmarks/identification.py --json identification.json

The record is that of a P-753 with 12 nm rms sensor noise; the model is Coleman-Hodgdon
hysteresis, second-order dynamics and an offset. The time of piezojax includes tracing
and compiling. SciPy's least_squares (trf, differences) uses a numba simulation of the
same model, from the same 16 starts in the same box, one after another; its compile time
is reported separately. Both fit the whole record.
"""

import argparse
import json
import time
from pathlib import Path

import jax.numpy as jnp
import numba
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares

from piezojax import (
    Record,
    identify,
)
from piezojax.catalog import p753
from piezojax.identification import free_run
from piezojax.identification.chain import structure

SAMPLES = 20_000
MODEL = "coleman_hodgdon+arma"


def p753_record(samples=SAMPLES, noise=p753.NOISE_RMS, seed=1):
    """Return a swept triangular input with tones up to 3 kHz, and the noisy output."""
    time_s = np.arange(samples) * p753.DT
    fade = np.linspace(1.0, 0.3, samples)
    voltage = 45.0 + 25.0 * fade * np.sin(2 * np.pi * 7.0 * time_s)
    for frequency, amplitude in ((43, 15), (310, 6), (700, 2), (1500, 2), (2900, 2)):
        voltage += amplitude * np.sin(2 * np.pi * frequency * time_s + frequency)
    clean = np.asarray(free_run(p753.plant(), jnp.asarray(voltage), 0.0))
    noisy = clean + noise * np.random.default_rng(seed).standard_normal(samples)
    return Record(voltage, noisy, p753.DT, source="simulated P-753")


@numba.njit(cache=False)
def simulated(x, a, b, c, rest_input, rest_output, a1, a2, b0, b1, b2, offset):
    """Return the trapezoid Coleman-Hodgdon output, then (3.30), then the offset."""
    gain = (b0 + b1 + b2) / (1.0 - a1 - a2)
    u, h = rest_input, rest_output
    h1 = h2 = h
    y1 = y2 = gain * h
    out = np.empty(x.size)
    for k in range(x.size):
        out[k] = y1 + offset
        dx = x[k] - u
        s = 1.0 if dx >= 0.0 else -1.0
        half = 0.5 * s * c * dx
        force = 0.5 * s * a * (x[k] + u) * dx + b * dx
        h = (force + (1.0 + half) * h) / (1.0 - half)
        u = x[k]
        y = a1 * y1 + a2 * y2 + b0 * h + b1 * h1 + b2 * h2
        h2, h1, y2, y1 = h1, h, y1, y
    return out


ORDER = (
    "hysteresis.a",
    "hysteresis.b",
    "hysteresis.c",
    "hysteresis.rest_input",
    "hysteresis.rest_output",
    "dynamics.autoregressive.0",
    "dynamics.autoregressive.1",
    "dynamics.moving.0",
    "dynamics.moving.1",
    "dynamics.moving.2",
    "calibration.offset",
)


def by_scipy(record):
    """Return the best RMS error, the seconds, and the seconds of compiling."""
    shape = structure(MODEL, record)
    slope = float(shape.system.parts[0].b)
    low, high = np.asarray(shape.space.lower), np.asarray(shape.space.upper)

    def residuals(unit):
        values = dict(
            zip(shape.space.paths, low + unit * (high - low), strict=True),
            **{"hysteresis.b": slope},
        )
        error = simulated(record.input, *(values[name] for name in ORDER))
        error -= record.output
        return np.where(np.isfinite(error), np.clip(error, -1e6, 1e6), 1e6)

    begin = time.perf_counter()
    residuals(shape.starts[0])
    compiled = time.perf_counter()
    found = [
        least_squares(residuals, np.clip(start, 1e-3, 1 - 1e-3), bounds=(0.0, 1.0))
        for start in shape.starts
    ]
    ended = time.perf_counter()
    best = min(np.sqrt(2.0 * one.cost / record.samples) for one in found)
    return best, ended - compiled, compiled - begin


def by_piezojax(record):
    """Return the RMS error and the seconds, tracing included."""
    begin = time.perf_counter()
    whole = slice(0, record.samples)
    fit = identify(record, MODEL, train=whole, validate=whole)
    return fit.report.train.rmse, time.perf_counter() - begin


def main():
    """Run both and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    path = parser.parse_args().json
    record = p753_record()
    rmse, seconds = by_piezojax(record)
    rows = [{"engine": "piezojax", "rmse_um": rmse, "seconds": seconds}]
    rmse, seconds, compile_s = by_scipy(record)
    rows.append(
        {
            "engine": "scipy+numba",
            "rmse_um": rmse,
            "seconds": seconds,
            "compile_s": compile_s,
        }
    )
    table = Table(title=f"{MODEL}, {SAMPLES} samples, 16 starts")
    for column in ("engine", "rmse (um)", "seconds", "x piezojax"):
        table.add_column(column)
    for row in rows:
        ratio = row["seconds"] / rows[0]["seconds"]
        cells = f"{row['rmse_um']:.5f}", f"{row['seconds']:.1f}", f"{ratio:.1f}"
        table.add_row(row["engine"], *cells)
    Console().print(table)
    path.write_text(json.dumps({"rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
