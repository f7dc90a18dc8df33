"""Every registered hysteresis model keeps the protocol, has a recipe and an inverse.

A registered model is checked with the numbers that its recipe starts from, without a
line here. STARTS adds models without a recipe, and other schemes and shapes.
"""

from functools import cache, partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from oracles.bouc_wen import BENCHMARK

from piezojax import load, save, simulate
from piezojax.core import registry
from piezojax.core.parameter import parameter
from piezojax.core.recipe import Extent, Fittable, Part, Recipe, around
from piezojax.core.space import space_of
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
from piezojax.hysteresis.model import LAWS, hystereses, input_before

EXTENT = Extent(
    low=0.0,
    high=100.0,
    first=(0.0, 0.0),
    slope=0.12,
    centre=0.0,
    span=12.0,
    dt=1e-3,
    duration=2.0,
)
KINDS = {
    name: kind
    for name, kind in registry.parts().items()
    if kind.part.place == "hysteresis"
}


class Bowed(Hysteresis, Fittable):
    """A model from outside: y = slope (x + m), m moves towards x - m as |dx| passes."""

    part: ClassVar[Part] = Part("bowed", "hysteresis", "A model of this test")

    slope: jax.Array = parameter("um/V", "slope", above=0.0)
    pull: jax.Array = parameter("1/V", "pull", least=0.0)

    @classmethod
    def recipe(cls, extent):
        slope = around(extent.slope, 0.1, 3.0)
        pull = around(0.01, 0.1, 5.0)
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


@pytest.fixture(params=[*KINDS.values(), Bowed], ids=[*KINDS, "from outside"])
def kind(request):
    return request.param


@pytest.fixture(params=STARTS)
def name(request):
    return request.param


@cache
def started(name):
    return STARTS[name]()


# One program for each model: its outputs, states and slopes in a batch of runs.

TURNS = np.array([11.3, 43.1, 23.7, 71.9, 51.3, 86.7, 57.1, 66.9, 38.3, 21.1, 47.7])
PATH = np.repeat(TURNS, 2)  # Every turn is followed by a pause.
OTHER = 0.5 * PATH + 9.1
RESTS = (-7.3, 0.0, 30.0, 107.1)
QUICK = {"xla_backend_optimization_level": 0}
"""Options of the compiler: a program that runs once need not be a fast one."""

STEP = 1e-5
"""Change of a parameter and of a turn for their difference quotients, relative."""


class Runs(NamedTuple):
    """Runs along PATH, along OTHER with changed parameters, at RESTS, for differences.

    ``expected`` are the difference quotients by parameters, then by turns, each by a
    relative change; ``found`` are the gradients likewise.
    """

    size: float
    other: Hysteresis
    outputs: jax.Array
    first: object
    last: object
    slopes: tuple
    found: np.ndarray
    expected: np.ndarray


@cache
def runs(name):
    flat, unravel = ravel_pytree(started(name))
    flat = np.asarray(flat)

    def run(values, path):
        system = unravel(values)
        first = system.init(path[0])
        last, outputs = simulate(system, path, first, segment=PATH.size)
        loss = jnp.sin(1.0 + jnp.arange(outputs.size)) @ outputs
        return loss, (outputs, first, last)

    gradients = jax.value_and_grad(run, argnums=(0, 1), has_aux=True)
    size = np.where(flat == 0.0, 1e-3, np.abs(flat))
    turns = np.repeat(np.diag(TURNS), 2, axis=1)
    moves = STEP * np.vstack(
        [
            np.hstack([np.diag(size), np.zeros((flat.size, PATH.size))]),
            np.hstack([np.zeros((TURNS.size, flat.size)), turns]),
        ]
    )
    base = np.concatenate([flat, PATH])
    lanes = np.vstack(
        [
            base,
            np.concatenate([1.02 * flat, OTHER]),
            *(np.concatenate([flat, np.full(PATH.size, rest)]) for rest in RESTS),
            base + moves,
            base - moves,
        ]
    )
    program = jax.jit(jax.vmap(gradients), compiler_options=QUICK)
    (losses, (outputs, first, last)), slopes = program(
        lanes[:, : flat.size], lanes[:, flat.size :]
    )
    upper, lower = np.split(np.asarray(losses[2 + len(RESTS) :]), 2)
    by_turn = slopes[1][0].reshape(-1, 2).sum(1) * TURNS
    return Runs(
        size=float(np.sum(np.abs(outputs[0]))),
        other=unravel(1.02 * flat),
        outputs=outputs,
        first=first,
        last=last,
        slopes=slopes,
        found=np.concatenate([slopes[0][0] * size, by_turn]),
        expected=(upper - lower) / (2.0 * STEP),
    )


def test_at_rest_it_stays_at_rest(name):
    found, rests = runs(name), slice(2, 2 + len(RESTS))
    for last, first in zip(
        jax.tree.leaves(found.last), jax.tree.leaves(found.first), strict=True
    ):
        np.testing.assert_allclose(last[rests], first[rests], rtol=1e-11, atol=1e-11)
    outputs = found.outputs[rests]
    np.testing.assert_allclose(
        outputs, outputs[:, :1].repeat(PATH.size, 1), rtol=1e-11, atol=1e-11
    )
    assert all(np.all(np.isfinite(slope[rests])) for slope in found.slopes)


def test_compiled_and_batched_it_computes_the_same(name):
    found = runs(name)
    system = found.other
    state, stepping = system.init(OTHER[0]), resolve(system)
    for x, expected in zip(OTHER[:6], found.outputs[1], strict=False):
        after, y = stepping.step(state, x)
        assert jax.tree.structure(after) == jax.tree.structure(state)
        np.testing.assert_allclose(y, expected, rtol=1e-11, atol=1e-12)
        state = after
    assert found.outputs.dtype == jnp.float64
    assert np.max(np.abs(np.diff(found.outputs[1, :6]))) > 0.0


def test_its_gradient_is_that_of_differences(name):
    found = runs(name)
    assert np.all(np.isfinite(found.found))
    np.testing.assert_allclose(
        found.found, found.expected, rtol=1e-5, atol=1e-8 * found.size
    )
    assert np.count_nonzero(found.expected) > 0.5 * found.expected.size


@pytest.fixture
def known(monkeypatch):
    """Bowed is registered, and no longer known afterwards."""
    registry.kinds()
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    registry.register(Bowed)


@pytest.mark.usefixtures("known")
def test_saved_it_comes_back(name, tmp_path):
    system = started(name)
    save(system, tmp_path / "model.json")
    back = load(tmp_path / "model.json")
    assert jax.tree.structure(back) == jax.tree.structure(system)
    for new, old in zip(jax.tree.leaves(back), jax.tree.leaves(system), strict=True):
        np.testing.assert_array_equal(new, old)


# Turns that lead through loops within loops, 16 samples a branch

CORNERS = [0.0, 100.0, 5.0, 90.0, 20.0, 75.0, 40.0, 60.0, 50.0]
INPUT = np.interp(np.arange(129) / 16.0, np.arange(9), CORNERS)


@partial(jax.jit, compiler_options=QUICK)
def missed(inverse, inputs):
    """Return how far the inverse misses outputs that the model has reached."""

    def sample(state, x):
        wanted = inverse.model.step(state, x)[1]
        voltage = inverse.solve(state, wanted)
        state, found = inverse.model.step(state, voltage)
        return state, found - wanted

    inverse = resolve(inverse)
    return jax.lax.scan(sample, inverse.model.init(inputs[0]), inputs)[1]


def test_its_inverse_reaches_what_is_wanted_or_has_a_reason(name):
    system = started(name)
    if system.dynamic:
        with pytest.raises(ValueError, match="contains dynamics and has no inverse"):
            system.inverse(0.0, 100.0)
        return
    inverse = system.inverse(0.0, 100.0)
    inputs = np.clip(INPUT, 1.0, 99.0)[1:]
    np.testing.assert_allclose(missed(inverse, inputs), 0.0, atol=1e-8)


# The recipe


@partial(jax.jit, compiler_options=QUICK)
def response(system, input):
    return simulate(system, input, system.init(input[0]))[1]


def test_it_is_a_hysteresis_that_names_known_laws(kind):
    assert issubclass(kind, Hysteresis)
    assert set(kind.laws) <= set(LAWS)
    system = recipe_of(kind)
    assert hystereses(system) == [system]
    assert kind.before is None or float(input_before(system, np.nan)) == 0.0


def test_its_recipe_starts_inside_its_bounds_and_moves(kind):
    recipe = kind.recipe(EXTENT)
    space_of(recipe.bounds).start(recipe.system)  # raises outside
    assert recipe.gain is None or recipe.gain in recipe.bounds
    assert set(recipe.own) <= set(recipe.bounds)
    outputs = np.asarray(response(recipe.system, INPUT))
    assert np.all(np.isfinite(outputs))
    assert 0.3 * EXTENT.span < np.ptp(outputs) < 3.0 * EXTENT.span
