"""Every registered hysteresis model: the protocol, a recipe and an inverse.

A registered model is checked with the first guess of its recipe, without an entry
here. STARTS adds models without a recipe, and other schemes and shapes.
"""

from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conformance import (
    EXTENT,
    INPUT,
    QUICK,
    HasARecipe,
    KeepsTheProtocol,
)
from oracles.bouc_wen import BENCHMARK

from piezojax.core import registry
from piezojax.core.parameter import parameter
from piezojax.core.recipe import Fittable, Part, Recipe, scaled_range
from piezojax.core.system import resolve
from piezojax.hysteresis import (
    BoucWen,
    ColemanHodgdon,
    Duhem,
    Hysteresis,
    HystereticARMA,
    HystereticOscillator,
    InverseHysteresis,
    NormalisedBoucWen,
    Preisach,
    RateDependentPreisach,
)
from piezojax.hysteresis.model import LAWS, hystereses

KINDS = {
    name: kind
    for name, kind in registry.parts().items()
    if kind.part.place == "hysteresis"
}


class Bowed(Hysteresis, Fittable):
    """A model from outside: y = slope (x + m), m tends to x - m along the path |dx|."""

    part: ClassVar[Part] = Part("bowed", "hysteresis", "A model of this test")

    slope: jax.Array = parameter("um/V", "slope", above=0.0)
    pull: jax.Array = parameter("1/V", "pull", least=0.0)

    @classmethod
    def recipe(cls, extent):
        slope = scaled_range(extent.slope, 0.1, 3.0)
        pull = scaled_range(0.01, 0.1, 5.0)
        return Recipe(cls(0.6 * extent.slope, 0.01), {"slope": slope, "pull": pull})

    def init(self, input=0.0):
        input = jnp.asarray(input)
        return input, 0.5 * input

    def step(self, state, input):
        last, memory = state
        share = 1.0 - jnp.exp(-self.pull * jnp.abs(input - last))
        memory = memory + share * (0.5 * input - memory)
        return (jnp.asarray(input), memory), self.slope * (input + memory)

    def inverse(self, lower, upper):
        return InverseHysteresis(self, lower, upper)


def curved_duhem():
    """Return a model with all four surfaces and an output of both variables."""
    return Duhem(
        reversible=((0.1, 1e-3), (-0.002,)),
        irreversible=((0.01, 2e-3), (-0.02, -1e-4)),
        reversible_modulus=((-0.003,),),
        irreversible_modulus=((1e-4, 1e-5), (-0.001,)),
        output=((0.2, 0.05, 1e-4), (0.8, 1e-3), (0.01,)),
        rest_input=3.0,
        rest_memory=0.5,
        substeps=2,
    )


def preisach(start):
    weights = np.tril(np.random.default_rng(0).uniform(0.05, 0.6, (5, 5)))
    return Preisach(weights, -5.0, 105.0, -1.5, 31.7, start)


def oscillator():
    value = BENCHMARK
    hysteresis = BoucWen(
        value["alpha"],
        value["beta"] * value["gamma"],
        value["beta"] * value["delta"],
        value["nu"],
    )
    return HystereticOscillator(
        value["mass"], value["damping"], value["stiffness"], hysteresis, 1e-3
    )


def hysteretic_arma():
    first, second = (0.0003, -0.0002, 0.0006), (0.004, 0.001, 0.009)
    return HystereticARMA(
        -0.05, (1.6, -0.62), first, second, 0.7, rest_input=-12.0, scheme="quadratic"
    )


def recipe_of(kind):
    return kind.recipe(EXTENT).system


STARTS = {name: partial(recipe_of, kind) for name, kind in KINDS.items()}
STARTS |= {"from outside": partial(recipe_of, Bowed)}
STARTS |= {
    f"coleman_hodgdon, {scheme}": partial(
        ColemanHodgdon, 0.0077, 0.1167, -0.0487, 1.0, 0.5, scheme=scheme
    )
    for scheme in ("trapezoid", "quadratic", "voros", "exact")
}
STARTS |= {
    f"bouc_wen, {shape[-1]}": partial(BoucWen, 0.12, *shape)
    for shape in ((0.012, -0.008, 1.3), (9e-3, 3e-3, 1.0), (2e-2, 5e-3, 0.7))
}
STARTS |= {
    f"normalised_bouc_wen, {shape[-1]}": partial(
        NormalisedBoucWen, 0.12, -1.0, 0.04, *shape, rest_input=-3.0
    )
    for shape in ((1.2, 1.5), (0.7, 2.0))
}
STARTS |= {
    "normalised_bouc_wen, exact": partial(
        NormalisedBoucWen, 0.12, -1.0, 0.04, 0.6, rest_input=-3.0, scheme="exact"
    ),
    "duhem, curved": curved_duhem,
    "preisach, virgin": partial(preisach, "virgin"),
    "preisach, saturated": partial(preisach, "saturated"),
    "rate_dependent_preisach": lambda: RateDependentPreisach(
        preisach("virgin"), jnp.flip(preisach("virgin").weights.T, (0, 1)), 5e3, 1e-3
    ),
    "hysteretic_arma": hysteretic_arma,
    "hysteretic_oscillator": oscillator,
}


class TestProtocol(KeepsTheProtocol):
    models = STARTS
    unregistered = (Bowed,)


FITTABLE = KINDS | {"from outside": Bowed}


class TestRecipe(HasARecipe):
    kinds = FITTABLE


@partial(jax.jit, compiler_options=QUICK)
def missed(inverse, inputs):
    """Return the errors of the inverse for outputs that the model has reached."""

    def sample(state, x):
        wanted = inverse.model.step(state, x)[1]
        voltage = inverse.solve(state, wanted)
        state, found = inverse.model.step(state, voltage)
        return state, found - wanted

    inverse = resolve(inverse)
    return jax.lax.scan(sample, inverse.model.init(inputs[0]), inputs)[1]


@pytest.mark.parametrize("name", STARTS)
def test_the_inverse_reaches_every_output_or_raises_the_reason(name):
    system = STARTS[name]()
    if system.dynamic:
        with pytest.raises(ValueError, match="contains dynamics and has no inverse"):
            system.inverse(0.0, 100.0)
        return
    inverse = system.inverse(0.0, 100.0)
    inputs = np.clip(INPUT, 1.0, 99.0)[1:]
    np.testing.assert_allclose(missed(inverse, inputs), 0.0, atol=1e-8)


@pytest.mark.parametrize("kind", FITTABLE.values(), ids=FITTABLE)
def test_the_model_declares_known_laws(kind):
    assert issubclass(kind, Hysteresis)
    assert set(kind.laws) <= set(LAWS)
    system = recipe_of(kind)
    assert hystereses(system) == [system]
