"""Linear state-space models, sample by sample from (6.1)."""

import numpy as np


def simulate(A, B, C, D, u, x):
    """Return the outputs y(k) = C x(k) + D u(k) from the state x at k = 0."""
    outputs = []
    for sample in np.asarray(u):
        outputs.append(C @ x + D @ sample)
        x = A @ x + B @ sample
    return np.array(outputs)


def markov(A, B, C, count):
    """Return C A^s B for s = 0 .. count-1."""
    return np.array([C @ np.linalg.matrix_power(A, s) @ B for s in range(count)])


def random_stable(seed, states, inputs, outputs):
    """Return random A, B, C, D whose largest pole has modulus 0.9."""
    draw = np.random.default_rng(seed).standard_normal
    A = draw((states, states))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    return A, draw((states, inputs)), draw((outputs, states)), draw((outputs, inputs))
