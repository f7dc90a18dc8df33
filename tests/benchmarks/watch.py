"""False alarms of ``watch`` and what it finds.

    python tests/benchmarks/watch.py [--stages 100] [--seed 22]

Each stage of tests/oracles/watched_stage.py has a baseline of 12 runs. Ten further runs
of the unchanged stage are compared with it, then three with the gain changed by 10 %,
up or down. The bar: as many false alarms as stated, within the spread of their number;
the change found within three runs on 95 % of the stages.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy import stats

import piezojax as pj
from piezojax.stages import Baseline

sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles.watched_stage import DT, REFERENCE, runs

BASELINE, HEALTHY, CHANGED, START = 12, 10, 3, 200
RATES = 0.01, 0.05


def records(random, gains):
    return [
        pj.Record(voltage, reading, DT, reference=REFERENCE)
        for reading, voltage in zip(*runs(random, gains), strict=True)
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stages", type=int, default=100)
    parser.add_argument("--seed", type=int, default=22)
    chosen = parser.parse_args()
    random = np.random.default_rng(chosen.seed)
    judged = {rate: [] for rate in RATES}
    found = []
    for _ in range(chosen.stages):
        factor = random.choice([0.9, 1.1])
        whole = BASELINE + HEALTHY
        gains = np.r_[np.ones(whole), np.full(CHANGED, factor)]
        every = records(random, gains)
        known = Baseline(every[:BASELINE], START)
        for rate in RATES:
            judged[rate] += [
                known.judge(one, rate).moved for one in every[BASELINE:whole]
            ]
        found.append(any(known.judge(one).moved for one in every[whole:]))
    count = HEALTHY * chosen.stages
    for rate in RATES:
        low, high = stats.binom.interval(0.99, count, rate)
        print(
            f"stated {100 * rate:g} %: {sum(judged[rate])} false alarms in {count} "
            f"runs (99 % of such numbers: {low:.0f} to {high:.0f})"
        )
    print(f"a gain changed by 10 %: found on {sum(found)} of {len(found)} stages")


if __name__ == "__main__":
    main()
