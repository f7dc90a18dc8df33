"""Slew rate of the amplifier in front of a stage, from a record."""

from collections.abc import Callable

import numpy as np

JUMP, STEPS, RARE = 0.05, 5, 0.02
"""Change of the input in a sample, as a share of its range, that is a step; fewest
steps that show a slew rate, and largest share of samples with a step."""

ALONE = 3.0
"""Ratio of a step to the changes beside it, of an input that moves between its steps.
"""

SAMPLES = tuple(np.geomspace(0.75, 75.0, 12))
"""Durations tried for the largest step at the slew rate, in samples."""

ROUNDS = 3
"""Refinements of the slew rate, each with half the logarithmic step of the last."""

DROP, CLEAR = 0.95, 0.8
"""Factors by which a slew rate must lower the error, with steps and without. Without
steps the error of the full model must fall as much: on forty stages without a limit in
their records, that of a mode and a lag went to 0.69 of itself at the least, and that of
the full model rose to 1.4 times itself or more wherever the first one fell below CLEAR.
"""


def has_steps(x: np.ndarray) -> bool:
    """Return whether ``x`` [samples] has several steps and is slow between them."""
    jumps = np.abs(np.diff(x)) > JUMP * np.ptp(x)
    return int(np.sum(jumps)) >= STEPS and bool(np.mean(jumps) < RARE)


def few_steps(x: np.ndarray) -> float:
    """Return the largest step of ``x`` if it has steps too few to show a slew rate.

    It is 0 for other inputs. A single ramp at the slew rate looks like a delay. A step
    is larger than the changes before and after it by the factor ``ALONE``.
    """
    changes = np.abs(np.diff(x, prepend=x[0], append=x[-1]))
    beside = np.maximum(changes[:-2], changes[2:])
    inner = changes[1:-1]
    steps = inner[(inner > JUMP * np.ptp(x)) & (inner > ALONE * beside)]
    return float(np.max(steps)) if 0 < steps.size < STEPS else 0.0


def slewed(x: np.ndarray, most: float) -> np.ndarray:
    """Return ``x`` slewed by at most ``most`` per sample, averaged over each sample.

    The result is that of ``dynamics.AmplifierSlew`` from rest under the first sample.
    """
    found, last = np.empty_like(x), float(x[0])
    for k, value in enumerate(x.tolist()):
        change = min(max(value - last, -most), most)
        last += change
        found[k] = last - 0.5 * change * abs(change) / most
    return found


def slew_rate(x: np.ndarray, cost: Callable[[np.ndarray], float]) -> float | None:
    """Return the largest change of ``x`` in a sample at the slew rate, or None.

    ``cost`` returns the error of a fit with a given input. The best rate of a geometric
    grid is refined. It is returned if it gives a clearly lower error than ``x`` itself,
    and if the largest change takes more than a sample: a shorter ramp looks like a
    delay. Without steps the grid is coarse, and the error must drop more: an amplifier
    that cannot follow a fast chirp makes it smaller. A few steps show nothing.
    """
    steps = has_steps(x)
    grid = SAMPLES if steps else SAMPLES[1::2]
    largest = float(np.max(np.abs(np.diff(x))))
    if largest == 0.0 or (not steps and few_steps(x) > 0.0):
        return None
    costs = {samples: cost(slewed(x, largest / samples)) for samples in grid}
    best, ratio = min(costs, key=lambda key: costs[key]), grid[1] / grid[0]
    own = cost(x)
    if not costs[best] < DROP * own:
        return None
    for _ in range(ROUNDS):
        ratio = np.sqrt(ratio)
        for samples in (best * ratio, best / ratio):
            costs[samples] = cost(slewed(x, largest / samples))
        best = min(costs, key=lambda key: costs[key])
    shown = best > 1.0 and costs[best] < (DROP if steps else CLEAR) * own
    return float(largest / best) if shown else None
