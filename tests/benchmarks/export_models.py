"""Models that ``identify`` fits, as plants for exports.py.

A part has the first guess of its recipe, for an input of 0 to 100 V and a gain of
0.12 um/V; a whole model has plausible numbers.
"""

from functools import partial

import numpy as np

from piezojax.core.axes import Packed
from piezojax.core.recipe import Extent, Resonance
from piezojax.core.registry import parts
from piezojax.dynamics import AmplitudeScheduled, NeuralStateSpace, StateSpace
from piezojax.hysteresis import (
    BoucWen,
    HystereticARMA,
    HystereticOscillator,
    Preisach,
    RateDependentPreisach,
)

DT = 5e-5  # s
MODES = (Resonance(310.0, 0.02, 0.7), Resonance(820.0, 0.01, 0.3))
EXTENT = Extent(0.0, 100.0, (0.0, 0.0), 0.12, 0.0, 12.0, DT, 1.0, modes=MODES)
LEVELS = (20.0, 40.0, 60.0)


def weights(seed):
    return np.tril(np.random.default_rng(seed).uniform(0.0, 0.1, (10, 10)))


def preisach():
    return Preisach(weights(0), 0.0, 100.0, -1.5, 0.0)


def rate_dependent_preisach():
    return RateDependentPreisach(preisach(), weights(1), 7e3, DT)


def state_space(damping=0.98):
    A = damping * np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    return StateSpace(A, [[0.01], [0.02]], [[1.0, 0.5]], [[0.0]], DT)


def amplitude_scheduled():
    models = tuple(map(state_space, (0.98, 0.97, 0.96)))
    return AmplitudeScheduled(models, LEVELS, 0.02)


def neural_state_space():
    draw = np.random.default_rng(0).standard_normal
    return NeuralStateSpace(
        0.5 * np.eye(3),
        0.01 * draw((3, 1)),
        draw((1, 3)),
        0.1 * draw((3, 4)),
        0.1 * draw((4, 3)),
        0.01 * draw((4, 1)),
        0.1 * draw(4),
        draw(1),
        draw(1),
    )


def bouc_wen():
    return HystereticOscillator(2.0, 10.0, 5e4, BoucWen(5e4, 800.0, -1100.0), DT)


def hysteretic_arma():
    first, second = (0.00003, -0.00002, 0.00006), (0.004, 0.001, 0.009)
    return HystereticARMA(-0.05, (1.6, -0.62), first, second, 0.7)


def first_guess(kind):
    return kind.recipe(EXTENT).system


MODELS = {
    f"{name} (part)": partial(first_guess, kind) for name, kind in parts().items()
}
MODELS |= {
    "hysteretic_arma": hysteretic_arma,
    "preisach": preisach,
    "rate_dependent_preisach": rate_dependent_preisach,
    "state_space": lambda: Packed(state_space()),
    "amplitude_scheduled": lambda: Packed(amplitude_scheduled()),
    "bouc_wen": bouc_wen,
    "neural_state_space": neural_state_space,
}
