"""Small motion that shows the dynamics of a stage: random steps."""

import numpy as np
from jaxtyping import Float

SHARE = 0.05
"""Height of the largest step, as a share of the range of the reference."""

HOLDS = 5, 8, 12, 20, 40, 100
"""Numbers of samples between two steps; short ones excite fast modes."""

REST = 100
"""Samples before the first step, which show the noise."""

SEED = 22


def probe(reference: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Return small random steps (um) from the first sample of ``reference``.

    They stay within the range of ``reference`` and have its length. The same reference
    gives the same steps, so that two runs can be compared.
    """
    random = np.random.default_rng(SEED)
    samples, begin = len(reference), float(reference[0])
    low, high = float(np.min(reference)), float(np.max(reference))
    inward = 1.0 if high - begin >= begin - low else -1.0
    holds = random.choice(HOLDS, samples)
    heights = random.uniform(0.0, inward * SHARE * (high - low), samples)
    steps = np.repeat(heights, holds)[: max(samples - REST, 0)]
    return begin + np.concatenate([np.zeros(min(REST, samples)), steps])
