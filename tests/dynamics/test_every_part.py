"""Every registered part except hysteresis satisfies the protocol and has a recipe.

A registered part is checked with the first guess of its recipe, without an entry
here. MODELS adds models without a recipe, and other shapes.
"""

from functools import partial

import numpy as np
from conformance import EXTENT, HasARecipe, KeepsTheProtocol
from oracles.state_space import random_stable

from piezojax.core import registry
from piezojax.core.system import Affine, Delay
from piezojax.dynamics import (
    ARMA,
    AmplitudeScheduled,
    AnalogLowPass,
    Biquad,
    ExponentialCreep,
    FirstOrderLag,
    FirstOrderLeadLag,
    FractionalDelay,
    HighPass,
    LinearMap,
    LowPass,
    NeuralStateSpace,
    Notch,
    Oversampled,
    SecondOrderLag,
    SecondOrderLowPass,
    SpringDamperCreep,
    StateSpace,
)

DT = EXTENT.dt
KINDS = {
    name: kind
    for name, kind in registry.parts().items()
    if kind.part.place != "hysteresis"
}


def recipe_of(kind):
    return kind.recipe(EXTENT).system


def state_space(seed=0, inputs=2, outputs=2):
    return StateSpace(*random_stable(seed, 3, inputs, outputs), DT)


def scheduled():
    models = tuple(state_space(seed) for seed in range(3))
    return AmplitudeScheduled(models, (20.0, 40.0, 60.0), 0.02)


def neural():
    draw = np.random.default_rng(0).standard_normal
    return NeuralStateSpace(
        0.5 * np.eye(3),
        0.01 * draw((3, 2)),
        draw((2, 3)),
        0.1 * draw((3, 4)),
        0.1 * draw((4, 3)),
        0.01 * draw((4, 2)),
        0.1 * draw(4),
        draw(2),
        draw(2),
    )


MODELS = {name: partial(recipe_of, kind) for name, kind in KINDS.items()}
MODELS |= {
    "affine": lambda: Affine(2.0, -1.0),
    "whole delay": lambda: FirstOrderLag(2 * DT, DT) >> Delay(3),
    "delay between samples": lambda: FractionalDelay(2.3 * DT, DT, 4),
    "creep alone": lambda: ExponentialCreep((0.02, 0.1), (0.05, 0.5), DT, direct=0.0),
    "creep of two springs": lambda: SpringDamperCreep(
        (40.0, 90.0), (8.0, 300.0), 6.0, 2.5, DT
    ),
    "gain": lambda: ARMA((), (2.5,)),
    "fifth order": lambda: ARMA(
        (0.4, 0.1, -0.2, 0.05, 0.1), (0.2, -0.1, 0.3, 0.05, -0.02, 0.1)
    ),
    "more zeros than poles": lambda: ARMA((0.5,), (0.1, 0.2, 0.3, 0.4)),
}
MODELS |= {
    f"second order, {damping}": partial(SecondOrderLag, 800.0, damping, DT)
    for damping in (0.7, 1.0, 1.5)
}
MODELS |= {
    "low-pass": partial(LowPass, 120.0, DT),
    "low-pass of equal poles": partial(LowPass, 120.0, DT, 4, "equal poles", "hold"),
    "high-pass": partial(HighPass, 120.0, DT, 3),
    "lead-lag": partial(FirstOrderLeadLag, 60.0, 150.0, DT, "matched"),
    "second-order low-pass": partial(SecondOrderLowPass, 120.0, 0.7, DT),
    "biquad": partial(Biquad, 150.0, 0.05, 90.0, 0.6, DT),
    "notch": partial(Notch, 150.0, 0.4, 0.1, DT),
}
MODELS |= {
    f"analogue low-pass of order {order}": partial(AnalogLowPass, 120.0, DT, order)
    for order in (1, 4)
}
MODELS |= {
    "held": lambda: Oversampled(FirstOrderLag(2 * DT, DT), 4),
    "linear map": lambda: LinearMap([[1.0, -0.5], [0.2, 2.0]]),
    "state_space": state_space,
    "scheduled": scheduled,
    "neural_state_space": neural,
}
CHANNELS = dict.fromkeys(
    ("linear map", "state_space", "scheduled", "neural_state_space"), 2
)
"""Models whose input is an array, with its length."""


class TestProtocol(KeepsTheProtocol):
    models = MODELS
    channels = CHANNELS


class TestRecipe(HasARecipe):
    kinds = KINDS
