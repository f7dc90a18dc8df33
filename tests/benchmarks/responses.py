"""Test of the modes that are found in noisy frequency responses.

    python tests/benchmarks/responses.py [--stages 0:60] [--seed 1000]

Each stage of tests/oracles/modal_responses.py has 1 to 4 modes with 0.5 to 10 % damping
and a delay; its response has 800 lines from 10 Hz to 5 kHz. The command prints a line
for each stage with a mode that is not found within 0.2 % in frequency and 10 % in
damping, then the number of stages with all modes found, and the share of frequencies
and dampings within two standard errors. The bar is 57 of 60, and 95 % of the intervals.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import modal_responses

from piezojax.identification.estimators.modal_fit import modal_fit
from piezojax.identification.records.response import FrequencyResponse

LINES = np.linspace(10.0, 5000.0, 800)
FREQUENCY, DAMPING, KEPT = 2e-3, 0.1, 57


def judged(stage, fit):
    """Return the worst errors of frequency and damping, and all in standard errors."""
    worst, deviations = np.zeros(2), []
    for frequency, damping in zip(stage.frequency, stage.damping, strict=True):
        distances = [abs(one.value - frequency) for one in fit.frequency]
        i = int(np.argmin(distances))
        found, true = (fit.frequency[i], fit.damping[i]), (frequency, damping)
        errors = [one.value - x for one, x in zip(found, true, strict=True)]
        worst = np.maximum(worst, np.abs(errors) / true)
        deviations += [e / one.error for e, one in zip(errors, found, strict=True)]
    return worst, deviations


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", default="0:60")
    parser.add_argument("--seed", type=int, default=1000)
    options = parser.parse_args()
    first, last = map(int, options.stages.split(":"))
    good = right = 0
    deviations, began = [], time.perf_counter()
    for number in range(options.seed + first, options.seed + last):
        stage = modal_responses.stage(number)
        values = modal_responses.measured(stage, LINES, number)
        fit = modal_fit(FrequencyResponse(LINES, values))
        worst, more = judged(stage, fit)
        deviations += more
        kept = worst[0] < FREQUENCY and worst[1] < DAMPING
        alike = len(fit.frequency) == len(stage.frequency)
        good, right = good + kept, right + alike
        if not (kept and alike):
            modes = f"{len(fit.frequency)} modes for {len(stage.frequency)}"
            errors = f"{100 * worst[0]:.2g} %, damping {100 * worst[1]:.2g} %"
            print(f"stage {number}: {modes}, frequency {errors}", flush=True)
    count = last - first
    within = np.mean(np.abs(deviations) < 2.0)
    print(
        f"{good} of {count} within {100 * FREQUENCY:g} % and {100 * DAMPING:g} % "
        f"(bar {KEPT} of 60); the number of modes right in {right}; {100 * within:.1f} "
        f"% of the values within two standard errors; "
        f"{(time.perf_counter() - began) / count:.1f} s each"
    )
    return int(good * 60 < KEPT * count)


if __name__ == "__main__":
    sys.exit(main())
