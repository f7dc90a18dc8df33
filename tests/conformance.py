"""Tests of every model of a stage: the protocol of a System, and its recipe.

A suite subclasses both classes and names its models; each model runs in one program.
"""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from piezojax import load, save, simulate
from piezojax.core import registry
from piezojax.core.paths import replace
from piezojax.core.recipe import Extent, Fittable
from piezojax.core.space import space_of
from piezojax.core.system import System, resolve

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

TURNS = np.array([11.3, 43.1, 23.7, 71.9, 51.3, 86.7, 57.1, 66.9, 38.3, 21.1, 47.7])
PATH = np.repeat(TURNS, 2)  # a pause after every turning point
OTHER = 0.5 * PATH + 9.1
RESTS = (-7.3, 0.0, 30.0, 107.1)
QUICK = {"xla_backend_optimization_level": 0}
"""Options of the compiler for programs that run once: compile quickly."""

STEP = 1e-5
"""Relative changes of a parameter and of a turning point for difference quotients."""

# turning points of nested loops, 16 samples per branch
CORNERS = [0.0, 100.0, 5.0, 90.0, 20.0, 75.0, 40.0, 60.0, 50.0]
INPUT = np.interp(np.arange(129) / 16.0, np.arange(9), CORNERS)


class Runs(NamedTuple):
    """Runs along PATH, along OTHER with changed parameters, at RESTS, and changed ones.

    ``expected`` are the difference quotients by parameters, then by turning points,
    for relative changes; ``found`` are the gradients in the same order. ``weighty`` is
    the number of those by a turning point or a parameter that is not 0: the elements of
    a matrix that a model does not use are.
    """

    size: float
    other: System
    outputs: np.ndarray
    first: object
    last: object
    slopes: tuple
    found: np.ndarray
    expected: np.ndarray
    weighty: int


def shared(channels: int):
    """Return the factor from a scalar input to an array of the channels."""
    return np.linspace(1.0, 0.5, channels) if channels else 1.0


@cache
def runs_of(model: Callable[[], System], channels: int) -> Runs:
    """Run a model in one program; with channels its input is an array."""
    flat, unravel = ravel_pytree(model())
    flat = np.asarray(flat)

    def run(values, path):
        system = unravel(values)
        path = jax.vmap(lambda x: x * shared(channels))(path)
        first = system.init(path[0])
        last, outputs = simulate(system, path, first, segment=PATH.size)
        loss = jnp.sum(jnp.sin(1.0 + jnp.arange(outputs.size)) * outputs.ravel())
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
    found = program(lanes[:, : flat.size], lanes[:, flat.size :])
    # Every operation on an array of JAX would be a program of its own.
    (losses, (outputs, first, last)), slopes = jax.tree.map(np.asarray, found)
    upper, lower = np.split(losses[2 + len(RESTS) :], 2)
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
        weighty=np.count_nonzero(flat) + TURNS.size,
    )


class KeepsTheProtocol:
    """Tests of ``models``: functions by name, each of which makes one.

    ``channels`` is the number of inputs of a model whose input is an array,
    ``unregistered`` are classes that a user would register.
    """

    models: Mapping[str, Callable[[], System]] = {}
    channels: Mapping[str, int] = {}
    unregistered: tuple[type[System], ...] = ()

    def pytest_generate_tests(self, metafunc):
        metafunc.parametrize("name", self.models)

    @pytest.fixture
    def runs(self, name):
        return runs_of(self.models[name], self.channels.get(name, 0))

    @pytest.fixture
    def known(self, monkeypatch):
        registry.kinds()
        monkeypatch.setattr(registry, "_registered", dict(registry._registered))
        for kind in self.unregistered:
            registry.register(kind)

    def test_a_model_at_rest_stays_at_rest(self, runs):
        rests = slice(2, 2 + len(RESTS))
        for last, first in zip(
            jax.tree.leaves(runs.last), jax.tree.leaves(runs.first), strict=True
        ):
            np.testing.assert_allclose(
                last[rests], first[rests], rtol=1e-11, atol=1e-11
            )
        outputs = runs.outputs[rests]
        np.testing.assert_allclose(
            outputs, outputs[:, :1].repeat(PATH.size, 1), rtol=1e-11, atol=1e-11
        )
        assert all(np.all(np.isfinite(slope[rests])) for slope in runs.slopes)

    def test_compiled_and_batched_runs_equal_single_runs(self, runs, name):
        system, share = runs.other, shared(self.channels.get(name, 0))
        inputs = [jnp.asarray(x * share) for x in OTHER[:6]]
        state, stepping = system.init(inputs[0]), resolve(system)
        for x, expected in zip(inputs, runs.outputs[1], strict=False):
            after, y = stepping.step(state, x)
            assert jax.tree.structure(after) == jax.tree.structure(state)
            np.testing.assert_allclose(y, expected, rtol=1e-11, atol=1e-14 * runs.size)
            state = after
        assert runs.outputs.dtype == np.float64
        assert np.max(np.abs(np.diff(runs.outputs[1, :6], axis=0))) > 0.0

    def test_the_gradient_equals_finite_differences(self, runs):
        assert np.all(np.isfinite(runs.found))
        np.testing.assert_allclose(
            runs.found, runs.expected, rtol=1e-5, atol=1e-8 * runs.size
        )
        assert np.count_nonzero(runs.expected) > 0.5 * runs.weighty

    @pytest.mark.usefixtures("known")
    def test_a_model_is_saved_and_loaded(self, name, tmp_path):
        model = self.models[name]()
        save(model, tmp_path / "model.json")
        back = load(tmp_path / "model.json")
        assert jax.tree.structure(back) == jax.tree.structure(model)
        for new, old in zip(jax.tree.leaves(back), jax.tree.leaves(model), strict=True):
            np.testing.assert_array_equal(new, old)


@partial(jax.jit, compiler_options=QUICK)
def response(system, input):
    return simulate(system, input, system.init(input[0]))[1]


class HasARecipe:
    """Tests of the recipe of each of ``kinds``, classes by name."""

    kinds: Mapping[str, type[Fittable]] = {}

    def pytest_generate_tests(self, metafunc):
        metafunc.parametrize("name", self.kinds)

    def test_the_recipe_starts_inside_its_bounds_and_moves(self, name):
        kind = self.kinds[name]
        recipe = kind.recipe(EXTENT)
        space = space_of(recipe.bounds)
        for changes in recipe.alternatives:
            space.start(replace(recipe.system, changes))  # raises if outside
        assert recipe.gain is None or recipe.gain in recipe.bounds
        assert set(recipe.own) <= set(recipe.bounds)
        outputs = np.asarray(response(recipe.system, INPUT))
        assert np.all(np.isfinite(outputs))
        # A part behind a hysteresis has about unit gain.
        span = EXTENT.span if kind.part.place == "hysteresis" else np.ptp(INPUT)
        assert 0.3 * span < np.ptp(outputs) < 3.0 * span
