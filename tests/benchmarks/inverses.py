"""Sliding mode control of the P-753 with the inverses of two hysteresis models.

    python tests/benchmarks/inverses.py --json inverses.json

On a stage with Coleman-Hodgdon hysteresis and on one with Preisach hysteresis it
computes

1. the errors of both models, fitted to the same record of the stage, on that record and
   on another;
2. the errors of their inverses: each drives the hysteresis alone along the ten
   references, without dynamics or a loop, and so does a constant gain, K_e;
3. the tracking errors of the PID-based sliding mode controllers of chapter 5 with the
   printed gains: nominal, with each inverse, and with a disturbance observer.

RMS errors in nm without noise, from rest at zero, over the second of two windows, as
``python -m piezojax.reproduce`` reads Tables 5-3 and 5-5.
"""

import argparse
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import piezojax
from piezojax import (
    Feedback,
    simulate,
)
from piezojax.catalog import p753, p753_inverses
from piezojax.core.feedback import loop_inputs
from piezojax.core.rollout import Metric
from piezojax.hardware import (
    Sensor,
)
from piezojax.reproduction.cell import window
from piezojax.signals import waveforms as signals

GAINS = ("5-2", "5-4")  # tables
NAMES = ("nominal", "Coleman-Hodgdon inverse", "Preisach inverse", "observer")


class Window(Metric):
    """Metric: mean square error (um^2) of the displacement, ``start`` to ``stop``."""

    start: jax.Array
    stop: jax.Array

    def init(self):
        return jnp.zeros(())

    def update(self, total, index, output):
        inside = (index >= self.start) & (index < self.stop)
        error = output.displacement - output.reference
        return total + jnp.where(inside, error**2, 0.0)

    def result(self, total):
        return total / (self.stop - self.start)


@eqx.filter_jit
def mean_squares(controller, plant, references, starts, stops):
    """Return the mean square error (um^2) of each reference."""
    loop = Feedback(controller, plant, p753.actuator(), Sensor(0.0))
    state = loop.init(0.0, holding=0.0)

    def one(reference, start, stop):
        inputs = loop_inputs(reference)
        metric = Window(start, stop)
        segment = reference.size
        return simulate(loop, inputs, state, metric=metric, segment=segment)[1]

    return jax.vmap(one)(references, starts, stops)


def references():
    """Return the ten references (um), one per row, and their windows in samples."""
    lengths = np.array([round(window(name) * p753.RATE) for name in signals.THESIS])
    time = jnp.arange(2 * lengths.max()) / p753.RATE
    rows = [signals.signal(name, time) for name in signals.THESIS]
    return jnp.stack(rows), jnp.asarray(lengths), jnp.asarray(2 * lengths)


def other_input():
    """Return another input (V) than the fitted one: two sines, from rest at 0 V."""
    time = np.arange(2 * round(p753.RATE)) * p753.DT
    wave = 18.0 * np.sin(2 * np.pi * 10.0 * time) + 20.0 * np.sin(
        2 * np.pi * 3.3 * time
    )
    return (45.0 + wave) * np.minimum(time / 0.1, 1.0)


def record_errors(plant, record, models):
    """Return the RMS errors (nm) of the models on the fitted and on another record."""
    found = {}
    for name, input in (
        ("fitted record", record.input),
        ("other record", other_input()),
    ):
        true = p753_inverses.response(plant, input)
        for model, inverse in models.items():
            behind = piezojax.series(hysteresis=inverse.model, dynamics=plant.parts[1])
            error = p753_inverses.response(behind, input) - true
            found[f"{model}, {name}"] = 1e3 * float(np.sqrt(np.mean(error**2)))
    return found


def study(truth, progress):
    """Return all figures of the stage with the hysteresis ``truth``."""
    plant = p753_inverses.PLANTS[truth]()
    record = p753_inverses.record_of(plant)
    inverses = {
        "Coleman-Hodgdon": p753_inverses.coleman_hodgdon_inverse(record),
        "Preisach": p753_inverses.preisach_inverse(record),
    }
    records = record_errors(plant, record, inverses)
    progress(f"{truth}: fitted")
    followed = references()
    alone = {"constant gain": piezojax.core.system.Affine(1.0 / p753.GAIN), **inverses}
    left = {
        name: by_reference(left_over(inverse, plant.parts[0], *followed))
        for name, inverse in alone.items()
    }
    progress(f"{truth}: inverses alone")
    loops = {}
    for table in GAINS:
        feedback = p753.inversion(table).feedback
        controllers = (
            p753.sliding_mode(table),
            *(
                piezojax.control.InversionControl(feedback, i)
                for i in inverses.values()
            ),
            p753.disturbance_observer(table),
        )
        for name, controller in zip(NAMES, controllers, strict=True):
            row = f"{name}, Table {table}"
            loops[row] = by_reference(mean_squares(controller, plant, *followed))
            progress(f"{truth}: {row}")
    return {"records": records, "inverses": left, "loops": loops}


@eqx.filter_jit
def left_over(inverse, hysteresis, references, starts, stops):
    """Return the mean square (um^2) of the output of inverse and hysteresis minus r."""

    def one(reference, start, stop):
        system = piezojax.core.system.Series((inverse, hysteresis))
        error = simulate(system, reference, system.init(0.0))[1] - reference
        index = jnp.arange(reference.size)
        inside = (index >= start) & (index < stop)
        return jnp.sum(jnp.where(inside, error**2, 0.0)) / (stop - start)

    return jax.vmap(one)(references, starts, stops)


def by_reference(squares):
    """Return RMS errors (nm) by the name of the reference."""
    return dict(zip(signals.THESIS, 1e3 * np.sqrt(np.asarray(squares)), strict=True))


def mean(errors):
    """Return the geometric mean over the references."""
    return float(np.exp(np.mean([np.log(errors[name]) for name in signals.THESIS])))


def shown(errors):
    """Return geometric mean and worst as text, or a single number."""
    if not isinstance(errors, dict):
        return f"{errors:.1f}"
    return f"{mean(errors):.1f}, {max(errors.values()):.1f}"


TITLES = {
    "records": "Fitted models: error of the model",
    "inverses": "Inverse and hysteresis alone: geometric mean of ten references, worst",
    "loops": "Loops: geometric mean of ten references, worst",
}


def main():
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    path = parser.parse_args().json
    begin, console = time.perf_counter(), Console(width=100)

    def progress(text):
        console.print(f"{time.perf_counter() - begin:6.0f} s  {text}", style="dim")

    found = {truth: study(truth, progress) for truth in p753_inverses.PLANTS}
    for part, title in TITLES.items():
        table = Table(title=f"{title} (nm)")
        table.add_column("")
        for truth in found:
            table.add_column(f"stage: {truth}")
        for row in next(iter(found.values()))[part]:
            table.add_row(row, *(shown(one[part][row]) for one in found.values()))
        console.print(table)
    path.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
