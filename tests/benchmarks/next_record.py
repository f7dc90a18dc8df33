"""Designed records against a sine, a chirp and a PRBS of the same limits.

    python tests/benchmarks/next_record.py [--seconds 0.5] [--draws 100] [RESULTS...]

For tuned loops, a record is designed that determines their promised figures best. The
others are the best of each kind for these figures: sines of 24 frequencies and three
amplitudes, chirps of three amplitudes, PRBS of 14 clocks and three amplitudes. All have
the same samples and the limits of voltage and slew rate. RESULTS are folders of
``tune`` with a fitted plant. Without them, the shipped studies p753_dob, p753_robust
and nv200 are tuned, and the parameters PATHS of their plant are unknown.

The plant is simulated with each record and new noise, and its parameters are estimated
by nonlinear least squares (optimistix), from parameters that are wrong by 20 times
their expected standard errors. The table has the rms over the figures of their relative
errors, as predicted and as estimated, and how many times that of the designed record is
smaller. Last is the range of estimated over predicted standard errors, for parameters
whose error should be below a tenth of their value.
The bar: twice as small as the best of the others; standard errors within 25 %.
"""

import argparse
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from rich.console import Console
from rich.table import Table

import piezojax as pj
from piezojax.identification.estimators.free_runs import free_run
from piezojax.signals.excitation import Generator
from piezojax.study import shipped
from piezojax.tuning.next_record import (
    DESCENTS,
    make_task,
    unknowns_at,
    unknowns_of,
)
from piezojax.tuning.record_search import best_voltages
from piezojax.tuning.result import load_loop

SHIPPED = "p753_dob", "p753_robust", "nv200"

PATHS = (
    *("hysteresis.a", "hysteresis.b", "hysteresis.c"),
    *("creep.gains.0", "creep.gains.1", "creep.gains.2"),
    *("dynamics.autoregressive.0", "dynamics.moving.0"),
    *("mode.frequency", "mode.damping"),
)
"""Parameters of the P-753 stage that a record determines one by one: the others scale
the same output."""

SLEW = 20_000.0
"""Slew rate of the generator, V/s."""

SHARES = (1.0, 0.2, 0.04)
"""Amplitudes of the others, as shares of half the range."""

WRONG = 20.0
"""Errors of the start in standard errors."""

KNOWN = 0.1
"""Relative standard error below which a parameter counts as determined."""


def others(generator, samples, random):
    """Yield kind, name and voltages of each of the other records."""
    time, duration = np.arange(samples) / generator.rate, samples / generator.rate
    for share in SHARES:
        height = 0.5 * share * generator.span
        for frequency in np.geomspace(2.0 / duration, generator.top, 24):
            peak = min(height, generator.slew / (2.0 * np.pi * frequency))
            sine = peak * np.sin(2.0 * np.pi * frequency * time)
            yield "sine", f"{frequency:.4g} Hz, {peak:.3g} V", generator.middle + sine
        ratio = generator.top * duration / 2.0
        frequency = 2.0 / duration * ratio ** (time / duration)
        peak = np.minimum(height, generator.slew / (2.0 * np.pi * frequency))
        chirp = peak * np.sin(2.0 * np.pi * np.cumsum(frequency) / generator.rate)
        yield "chirp", f"{height:.3g} V", generator.middle + chirp
        for clock in np.unique(np.geomspace(1, samples // 10, 14).astype(int)):
            bits = random.choice([-1.0, 1.0], samples // clock + 1)
            wanted = generator.middle + height * np.repeat(bits, clock)[:samples]
            name = f"{1e3 * clock / generator.rate:.3g} ms, {height:.3g} V"
            yield "PRBS", name, generator.followed(wanted)


@eqx.filter_jit
def estimates(unknowns, voltages, noise, start):
    """Return the estimated changes [draws, n] from records with ``noise``."""

    def output(changes):
        return free_run(unknowns.at(changes[:-1]), voltages, voltages[0]) + changes[-1]

    true = output(jnp.zeros(len(start) + 1))

    def one(noise):
        found = optx.least_squares(
            lambda changes, _: output(changes * scale) - true - noise,
            optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8),
            jnp.append(start, 0.0) / scale,
            options={"jac": "fwd"},
            max_steps=60,
            throw=False,
        )
        return (found.value * scale)[:-1]

    scale = jnp.append(jnp.abs(start), 1e-3)
    return jax.lax.map(one, noise)


def rms(errors):
    """Return the rms of ``errors``."""
    return float(np.sqrt(np.mean(np.square(errors))))


def judged(task, voltages, draws, random):
    """Return predicted and estimated errors of a record."""
    expected, parameters = task.errors(voltages)
    unknowns, noise = task.search.unknowns, float(task.search.noise)
    relative = parameters / np.asarray(unknowns.scales)
    signs = random.choice([-1.0, 1.0], relative.size)
    start = np.clip(WRONG * relative, None, 0.2) * signs
    found = np.asarray(
        estimates(
            unknowns,
            jnp.asarray(voltages),
            jnp.asarray(noise * random.standard_normal((draws, voltages.size))),
            jnp.asarray(start),
        )
    )
    covariance = found.T @ found / draws
    figures = [figure.relative_error(covariance) for figure in task.figures]
    ratios = (np.sqrt(np.diag(covariance)) / relative)[relative < KNOWN]
    return {
        "predicted": rms(expected),
        "estimated": rms(figures),
        "least": float(ratios.min()),
        "largest": float(ratios.max()),
    }


def lines_of(case, loop, arguments, paths=None):
    """Return the line of each record for the tuned ``loop``."""
    limits, random = case.study.actuator, np.random.default_rng(21)
    generator = Generator(limits.lower, limits.upper, case.study.rate, SLEW)
    samples = round(arguments.seconds * generator.rate)
    unknowns = unknowns_at(case, paths) if paths else unknowns_of(case)
    task = make_task(case, loop, generator, samples, unknowns)
    silent = lambda loss: None  # noqa: E731
    design, _ = best_voltages(task.search, generator, DESCENTS[0], random, silent)
    best = {"designed": ("", design)}
    for kind, name, voltages in others(generator, samples, random):
        error = rms(task.errors(voltages)[0])
        if kind not in best or error < best[kind][2]:
            best[kind] = name, voltages, error
    lines = []
    for kind, (name, voltages, *_) in best.items():
        line = judged(task, voltages, arguments.draws, random)
        lines.append({"loop": case.study.title, "record": f"{kind} {name}"} | line)
        lines[-1]["times"] = line["predicted"] / lines[0]["predicted"]
        print(lines[-1], flush=True)
    return lines


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("results", nargs="*", type=Path, metavar="RESULTS")
    parser.add_argument("--seconds", type=float, default=0.5, help="of each record")
    parser.add_argument("--draws", type=int, default=100, help="of the noise")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    lines = []
    for folder in arguments.results:
        lines += lines_of(*load_loop(folder, accept_unsafe=True), arguments)
    for study in () if arguments.results else SHIPPED:
        outcome = pj.tune(shipped(study))
        lines += lines_of(outcome.case, outcome.after, arguments, PATHS)
    table = Table(title=f"records of {arguments.seconds:g} s, {arguments.draws} draws")
    columns = "loop", "record", "predicted, %", "estimated, %", "times", "se ratios"
    for column in columns:
        table.add_column(column)
    for line in lines:
        table.add_row(
            line["loop"],
            line["record"],
            *(f"{100 * line[name]:.3g}" for name in ("predicted", "estimated")),
            f"{line['times']:.2f}",
            f"{line['least']:.2f} to {line['largest']:.2f}",
        )
    Console(width=140).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(lines, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
