"""Are the bands of measured responses honest, and are models of them?

    python tests/benchmarks/measured_responses.py [--draws 40] [--fits 10] [--lines 0]

The stage of tests/oracles/multisines.py, with sensor noise and, where said, a cubic
before it. For each method, over the draws: the share of the lines whose 95 % band of
magnitude and of phase holds the truth, and the variance, of noise and of distortion,
over the true one (from the noise alone, and from 200 realisations without it). Then
the modal fit of such responses: how often frequency, damping and gain lie within two
standard errors. ``--lines 100000`` also times the fit of as many lines. The bar is 93
to 97 % of each band, and variances within 10 % of the truth.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import modal_responses, multisines
from oracles.multisines import DT, LINES, PERIOD

from piezojax.identification.estimators.modal_fit import modal_fit
from piezojax.identification.estimators.robust import steady_response
from piezojax.identification.measured_response import (
    ResponseSettings,
    measure_responses,
)
from piezojax.identification.records.record import Record
from piezojax.identification.records.response import FrequencyResponse

NOISE, CUBIC = 0.02, 0.03
LOW, HIGH, NEAR = 0.93, 0.97, 0.1

CASES = (
    ("robust", 7, 4, 0.0),
    ("robust", 7, 4, CUBIC),
    ("robust", 2, 3, CUBIC),
    ("robust", 1, 5, 0.0),
    ("local_polynomial", 7, 2, CUBIC),
    ("local_polynomial", 1, 3, 0.0),
    ("local_polynomial", 1, 0, 0.0),
    ("welch", 1, 0, 0.0),
)
"""Method, realisations, periods (0: a normal input of 40 000 samples), cubic."""


def records(seed, realisations, periods, cubic):
    random = np.random.default_rng([77, seed])
    found = []
    for _ in range(realisations):
        one = multisines.multisine(random)
        input = np.tile(one, periods) if periods else random.standard_normal(40_000)
        output = multisines.output(input, random, cubic, NOISE)
        period = PERIOD if periods else None
        found.append(Record(input, output, DT, period=period))
    return found


def distortion():
    """Return the variance of the distortion of a realisation, without noise."""
    random, found = np.random.default_rng(78), []
    for _ in range(200):
        input = np.tile(multisines.multisine(random), 4)
        output = multisines.output(input, random, CUBIC)
        found.append(steady_response(input, output, DT, PERIOD).response)
    return float(np.mean(np.var(found, axis=0, ddof=1)))


def covered(responses, cubic):
    """Return the shares of lines in the bands, and variance over squared error."""
    magnitude, phase, squares, variances = [], [], [], []
    for found in responses:
        true = multisines.exact(found.frequency, cubic)
        half, turn = found.band()
        magnitude.append(np.mean(np.abs(np.abs(found.values) - np.abs(true)) <= half))
        phase.append(np.mean(np.abs(np.angle(found.values / true)) <= turn))
        squares.append(np.mean(np.abs(found.values / true - 1.0) ** 2))
        variances.append(np.mean(found.variance / np.abs(true) ** 2))
    return np.mean(magnitude), np.mean(phase), np.mean(variances) / np.mean(squares)


def standing(value, truth):
    return (value.value - truth) / value.error


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--fits", type=int, default=10)
    parser.add_argument("--lines", type=int, default=0)
    options = parser.parse_args()
    true_distortion = distortion()
    true_noise = NOISE**2 / (PERIOD / (2.0 * LINES.size))
    missed = 0
    for method, realisations, periods, cubic in CASES:
        settings = ResponseSettings(method=method)
        found = [
            measure_responses(records(seed, realisations, periods, cubic), settings)
            for seed in range(options.draws)
        ]
        responses = [response for ((response, _),) in found]
        in_band = covered(responses, cubic)
        text = f"magnitude {100 * in_band[0]:.1f} %, phase {100 * in_band[1]:.1f} %"
        text += f", variance {in_band[2]:.3f} of the squared error"
        missed += not all(LOW <= share <= HIGH for share in in_band[:2])
        missed += abs(in_band[2] - 1.0) > NEAR
        if realisations > 1 and method == "robust":
            noise = np.mean([one.noise for one in responses])
            noise *= realisations * (periods - 1) / true_noise
            text += f", noise {noise:.3f}"
            missed += abs(noise - 1.0) > NEAR
        if realisations > 1 and cubic:
            level = np.mean([one.distortion for one in responses]) / true_distortion
            text += f", distortion {level:.3f}"
            missed += abs(level - 1.0) > NEAR
        kind = f"{realisations} x {periods} periods" if periods else "normal input"
        print(f"{method}, {kind}{', cubic' if cubic else ''}: {text}", flush=True)
        deviations = []
        for response in responses[: options.fits]:
            fit = modal_fit(response)
            deviations += [
                standing(fit.frequency[0], 700.0),
                standing(fit.damping[0], multisines.ZETA),
                standing(fit.static_gain, 1.0 + 3.0 * cubic),
            ]
        if deviations:
            within = np.mean(np.abs(deviations) < 2.0)
            print(
                f"  {options.fits} fits: {100 * within:.0f} % of frequency, damping "
                "and gain within two standard errors, "
                f"{np.sqrt(np.mean(np.square(deviations))):.2f} rms",
                flush=True,
            )
    if options.lines:
        began, lines = time.perf_counter(), np.linspace(1.0, 5000.0, options.lines)
        stage = modal_responses.stage(1001)
        values = modal_responses.measured(stage, lines, 1)
        fit = modal_fit(FrequencyResponse(lines, values))
        worst = max(
            abs(one.value / true - 1.0)
            for one, true in zip(
                sorted(fit.frequency), sorted(stage.frequency), strict=False
            )
        )
        print(
            f"{options.lines} lines, merged into {fit.searched}: "
            f"{time.perf_counter() - began:.1f} s, {len(fit.frequency)} modes of "
            f"{len(stage.frequency)}, frequency within {100 * worst:.2g} %"
        )
    print(f"{missed} figures outside the bar")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
