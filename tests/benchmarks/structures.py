"""Does the search over structures find the right number of notches?

    python tests/benchmarks/structures.py [--plants 0:30] [--seed 19] [--json FILE]

Each plant of structure_plants.py has five light modes, of which 0 to 3 limit the loop;
the others are hardly excited. A PI with 0 to 3 notches is tuned for each
by the study of ``study_of``, with perturbed plants that no search has seen. A line for
each plant tells the modes that limit the loop, the notches chosen, and the errors.

The bars: the right number of notches for 27 of 30 plants, and no notch on noise, more
than NEAR from every mode that limits the loop.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parent))

from structure_plants import DELAY, DT, LIGHT, LIMIT, RATE, draw

import piezojax as pj
from piezojax.study import Study, build

NEAR = 0.1
"""Relative distance of a notch from its mode."""

COUNT, RIGHT = 30, 27
"""Plants, and how many must get the right number of notches."""

AMPLITUDE = 2.0


def study_of(plant, most=3):
    """Return the study of a plant: a PI with 0 to ``most`` notches."""
    modes = {
        "type": "Modes",
        "frequency": list(plant.frequency),
        "damping": list(plant.damping),
        "share": list(plant.share[1:]),
        "time_constant": [plant.lag],
        "dt": DT,
    }
    parts = [{"type": "Affine", "gain": plant.gain}, modes]
    parts.append({"type": "Delay", "samples": DELAY})
    half = 4.0 * AMPLITUDE / plant.gain
    light = range(1, LIGHT + 1)
    spread = {f"plant.1.frequency.{i}": 0.01 for i in light}
    spread |= {f"plant.1.damping.{i}": 0.3 for i in light}
    integral = {"lower": 1.0 / plant.gain, "upper": 2e4 / plant.gain, "scale": "log"}
    return {
        "title": f"plant {plant.seed}",
        "rate": RATE,
        "seed": plant.seed,
        "plant": {"type": "Series", "parts": parts},
        "actuator": {"lower": -half, "upper": half},
        "sensor": {"noise_rms": 0.001},
        "controller": {
            "type": "PID",
            "proportional": 1e-3 / plant.gain,
            "integral": 10.0 / plant.gain,
            "derivative": 0.0,
            "derivative_filter": 1e-4,
            "dt": DT,
        },
        "references": {
            "tune": ["SIN10", "SW30"],
            "unseen": ["TRI20"],
            "amplitude": AMPLITUDE,
            "duration": 0.2,
            "settle": 0.1,
        },
        "parameters": {
            "controller.integral": integral,
            "controller.proportional": {
                "lower": 1e-4 / plant.gain,
                "upper": 5.0 / plant.gain,
                "scale": "log",
            },
        },
        "ensemble": {"spread": spread, "tune": 0, "margins": 256, "holdout": 12},
        "constraints": {"sensitivity_peak": LIMIT},
        "optimiser": {"starts": 2, "candidates": 8, "steps": 15, "tolerance": 1e-3},
        "structures": {"notches": list(range(most + 1))},
    }


def judged(plant):
    """Tune the structures of a plant; return its line."""
    began = time.perf_counter()
    outcome = pj.tune(build(Study.model_validate(study_of(plant)), "structures.toml"))
    search = outcome.result.structures
    chosen = next(one for one in search.structures if one.chosen)
    relevant = np.array(plant.relevant)
    noise = [
        f
        for f in chosen.at_Hz
        if not relevant.size or np.min(np.abs(f / relevant - 1.0)) > NEAR
    ]
    return {
        "plant": plant.seed,
        "limiting_Hz": plant.relevant,
        "notches_Hz": chosen.notches_Hz,
        "right": chosen.notches == len(plant.limiting),
        "on_noise_Hz": noise,
        "alarms": outcome.result.alarms,
        "structures": [
            one.model_dump(exclude={"log_errors", "gains"}) for one in search.structures
        ],
        "seconds": time.perf_counter() - began,
    }


def text_of(line):
    """Return a line of the output."""

    def shown(frequencies):
        return " ".join(f"{f:.4g}" for f in frequencies) or "none"

    errors = [
        f"{one['notches']}: " + ("-" if e is None else f"{1e3 * e:.3g}")
        for one in line["structures"]
        for e in [one["error_um"]]
    ]
    return (
        f"{line['plant']}: limited by {shown(line['limiting_Hz'])}; notches at "
        f"{shown(line['notches_Hz'])}; {'right' if line['right'] else 'WRONG'}"
        + (f", ON NOISE {shown(line['on_noise_Hz'])}" if line["on_noise_Hz"] else "")
        + (f", {len(line['alarms'])} alarms" if line["alarms"] else "")
        + f"; nm: {', '.join(errors)}; {line['seconds']:.0f} s"
    )


def main():
    """Tune the plants and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plants", default=f"0:{COUNT}", metavar="FIRST:STOP")
    parser.add_argument("--seed", type=int, default=19, help="of the 30 plants")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    first, stop = map(int, arguments.plants.split(":"))
    console, lines = Console(), []
    with tempfile.TemporaryDirectory() as folder:
        # All plants have the same shape, so that their programs are compiled once.
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
        for number in range(first, stop):
            plant = draw(1000 * arguments.seed + number, number % 4)
            lines.append(judged(plant))
            console.print(text_of(lines[-1]), soft_wrap=True, highlight=False)
            if arguments.json:
                arguments.json.write_text(json.dumps(lines, indent=1), encoding="utf-8")
    right = sum(line["right"] for line in lines)
    noise = sum(len(line["on_noise_Hz"]) for line in lines)
    seconds = sum(line["seconds"] for line in lines)
    console.print(
        f"right number of notches for {right} of {len(lines)} plants (bar {RIGHT} of "
        f"{COUNT}); {noise} notches on noise (bar 0); {seconds:.0f} s",
        highlight=False,
    )


if __name__ == "__main__":
    main()
