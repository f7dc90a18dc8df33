"""Every registered hysteresis model keeps the protocol, its laws and its inverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import load, save, simulate
from piezojax.core.recipe import Extent
from piezojax.core.registry import parts
from piezojax.core.space import space_of
from piezojax.hysteresis import Hysteresis
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
    name: kind for name, kind in parts().items() if kind.part.place == "hysteresis"
}
# Loops that shrink about the middle of the range, 16 samples a branch.
CORNERS = [0.0, 100.0, 5.0, 90.0, 20.0, 75.0, 40.0, 60.0, 50.0]
INPUT = np.interp(np.arange(129) / 16.0, np.arange(9), CORNERS)


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


@jax.jit
def run(system, input):
    return simulate(system, input, system.init(input[0]))[1]


def test_it_is_a_hysteresis_that_names_known_laws(kind):
    assert issubclass(kind, Hysteresis)
    assert set(kind.laws) <= set(LAWS)
    system = kind.recipe(EXTENT).system
    assert hystereses(system) == [system]
    assert kind.before is None or float(input_before(system, np.nan)) == 0.0


def test_its_recipe_starts_inside_its_bounds_and_moves(kind):
    recipe = kind.recipe(EXTENT)
    space_of(recipe.bounds).start(recipe.system)  # raises outside
    assert recipe.gain is None or recipe.gain in recipe.bounds
    assert set(recipe.own) <= set(recipe.bounds)
    outputs = np.asarray(run(recipe.system, INPUT))
    assert np.all(np.isfinite(outputs))
    assert 0.3 * EXTENT.span < np.ptp(outputs) < 3.0 * EXTENT.span


def test_at_rest_it_stays_at_rest(kind):
    system = kind.recipe(EXTENT).system
    state = system.init(30.0)
    after, first = system.step(state, 30.0)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for new, old in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(system.step(after, 30.0)[1], first, rtol=1e-12)


def test_compiled_and_batched_it_computes_the_same(kind):
    system = kind.recipe(EXTENT).system
    few = INPUT[:40:4]
    state, eager = system.init(few[0]), []
    for x in few:
        state, y = system.step(state, x)
        eager.append(float(y))
    np.testing.assert_allclose(run(system, few), eager, rtol=1e-12, atol=1e-12)
    both = jax.vmap(lambda scale: run(system, scale * few))(jnp.array([1.0, 0.5]))
    np.testing.assert_allclose(both[0], eager, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(both[1], run(system, 0.5 * few), rtol=1e-12, atol=1e-12)


def test_its_gradient_is_that_of_differences(kind):
    system = kind.recipe(EXTENT).system
    weights = np.sin(1.0 + np.arange(INPUT.size))

    def loss(system):
        # Off the kinks of the first guess, where a difference is no derivative.
        return weights @ run(system, 0.7 + 0.971 * INPUT)

    leaves, tree = jax.tree.flatten(system)
    slopes = jax.tree.leaves(jax.grad(loss)(system))
    towards = [np.cos(i + 1.0) * 1e-6 * (1.0 + abs(x)) for i, x in enumerate(leaves)]
    above, below = (
        float(
            loss(
                jax.tree.unflatten(
                    tree, [x + s * d for x, d in zip(leaves, towards, strict=True)]
                )
            )
        )
        for s in (1.0, -1.0)
    )
    expected = sum(float(g * d) for g, d in zip(slopes, towards, strict=True))
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    size = sum(abs(float(g * d)) for g, d in zip(slopes, towards, strict=True))
    assert abs(0.5 * (above - below) - expected) <= 2e-3 * size


def test_saved_it_comes_back(kind, tmp_path):
    system = kind.recipe(EXTENT).system
    save(system, tmp_path / "model.json")
    back = load(tmp_path / "model.json")
    assert type(back) is kind
    for new, old in zip(jax.tree.leaves(back), jax.tree.leaves(system), strict=True):
        np.testing.assert_array_equal(new, old)


def test_its_inverse_reaches_what_is_wanted_or_has_a_reason(kind):
    system = kind.recipe(EXTENT).system
    if kind.dynamic:
        with pytest.raises(ValueError, match="contains dynamics and has no inverse"):
            system.inverse(0.0, 100.0)
        return
    inverse = system.inverse(0.0, 100.0)

    @jax.jit
    def missed(inverse, inputs):
        def sample(state, x):
            wanted = inverse.model.step(state, x)[1]
            voltage = inverse.solve(state, wanted)
            state, found = inverse.model.step(state, voltage)
            return state, found - wanted

        return jax.lax.scan(sample, inverse.model.init(inputs[0]), inputs)[1]

    inputs = np.clip(INPUT, 1.0, 99.0)[1:]
    np.testing.assert_allclose(missed(inverse, inputs), 0.0, atol=1e-8)
