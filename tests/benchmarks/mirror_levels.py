"""One model of the measured fine-steering mirror for three drive levels.

    python tests/benchmarks/mirror_levels.py [--order 36] [--steps 20]

``identify`` fits ``amplitude_scheduled`` to five realisations of each level of
shared/data/fsm_mirror (Floren et al., CC BY 4.0). A line for each level: the rms error
in um of the model on the last realisation, which no fit uses, over whole periods in
steady state.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import piezojax as pj
from piezojax.identification.estimators.estimate import Options
from piezojax.identification.estimators.frequency import periodic_errors

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "fsm_mirror"
LEVELS, RATE, PERIOD, REALISATIONS = (100, 200, 300), 6400.0, 8192, 6


def records(level):
    """Return the realisations of a level in mV: V to um, two periods each."""
    u, y = (np.load(FOLDER / f"{side}_{level}mV_train.npy") for side in "uy")
    columns = [
        [x[:, :, r].transpose(2, 0, 1).reshape(-1, 3) for x in (u, 1e6 * y)]
        for r in range(REALISATIONS)
    ]
    return [
        pj.Record(*each, 1.0 / RATE, source=f"{level} mV, {r}", period=PERIOD)
        for r, each in enumerate(columns)
    ]


def main():
    """Fit the model and print its errors."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--order", type=int, default=36)
    parser.add_argument("--steps", type=int, default=20)
    chosen = parser.parse_args()
    if not FOLDER.is_dir():
        sys.exit(f"{FOLDER} is not here: the records of the mirror are not shipped")
    every = {level: records(level) for level in LEVELS}
    both = slice(0, 2 * PERIOD)
    began = time.perf_counter()
    fit = pj.identify(
        [record for each in every.values() for record in each[:-1]],
        "amplitude_scheduled",
        train=both,
        validate=both,
        options=Options(order=chosen.order, steps=chosen.steps),
    )
    print(f"fitted in {time.perf_counter() - began:.0f} s")
    for level, each in every.items():
        # The model maps u(k) to y(k+1); the record is periodic.
        last = each[-1]
        ahead = np.roll(last.outputs, -1, axis=0)
        shifted = pj.Record(last.inputs, ahead, last.dt, period=PERIOD)
        error = periodic_errors(fit.system, [shifted]).mean()
        print(f"{level} mV: {error:.4f} um")


if __name__ == "__main__":
    main()
