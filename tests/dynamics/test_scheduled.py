"""AmplitudeScheduled against a plain loop and its limiting cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import state_space as oracle

from piezojax import (
    simulate,
)
from piezojax.dynamics import (
    AmplitudeScheduled,
    StateSpace,
)

DT = 1e-3
LEVELS = (0.5, 1.0, 3.0)
TIME_CONSTANT = 0.02


def matrices(seed):
    """Return two damped rotations that vary slightly with the seed, with two inputs."""
    draw = np.random.default_rng(seed).standard_normal
    A = np.zeros((4, 4))
    for k, (size, angle) in enumerate([(0.97, 0.5), (0.9, 1.4)]):
        pole = size * np.exp(1j * angle * (1.0 - 0.02 * seed))
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [
            [pole.real, -pole.imag],
            [pole.imag, pole.real],
        ]
    return A, draw((4, 2)), draw((1, 4)), draw((1, 2))


MATRICES = [matrices(seed) for seed in range(3)]


@pytest.fixture
def system():
    models = tuple(StateSpace(*m, DT) for m in MATRICES)
    return AmplitudeScheduled(models, LEVELS, TIME_CONSTANT)


def drive(samples=400):
    rising = np.linspace(0.0, 5.0, samples)[:, None]
    return rising * np.random.default_rng(4).standard_normal((samples, 2))


def plain(u):
    """Return the response of the same dynamics, sample by sample."""
    x, square, outputs = np.zeros(4), 0.0, []
    for sample in u:
        level = np.sqrt(square)
        A, B, C, D = (
            np.array([
                np.interp(level, LEVELS, values)
                for values in np.array([m[i] for m in MATRICES]).reshape(3, -1).T
            ]).reshape(MATRICES[0][i].shape)
            for i in range(4)
        )  # fmt: skip
        outputs.append(C @ x + D @ sample)
        x = A @ x + B @ sample
        square += DT / TIME_CONSTANT * (np.mean(sample**2) - square)
    return np.array(outputs)


def test_the_response_equals_a_plain_loop(system):
    u = drive()
    for run in (simulate, jax.jit(simulate)):
        found = run(system, u, system.init())[1]
        np.testing.assert_allclose(found, plain(u), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("level", "index"), [(0.0, 0), (0.5, 0), (1.0, 1), (9.0, 2)])
def test_at_a_level_the_model_of_that_level_applies(system, level, index):
    for name, expected in zip("ABCD", MATRICES[index], strict=True):
        found = getattr(system.at(jnp.asarray(level)), name)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_equal_models_give_one_linear_model():
    model = StateSpace(*MATRICES[0], DT)
    system = AmplitudeScheduled((model,) * 2, (1.0, 2.0), TIME_CONSTANT)
    expected = oracle.simulate(*MATRICES[0], drive(), np.zeros(4))
    found = simulate(system, drive(), system.init())[1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_the_state_decays_for_any_level(system):
    # Interpolated rotations are contractions: the state decreases in every step.
    state = np.random.default_rng(3).standard_normal(4)
    for level in np.random.default_rng(5).uniform(0.0, 4.0, 50):
        after = np.asarray(system.at(jnp.asarray(level)).A) @ state
        assert np.linalg.norm(after) < 0.9705 * np.linalg.norm(state)
        state = after


def test_the_gradient_is_finite_from_rest(system):
    @jax.jit
    @jax.value_and_grad
    def loss(amplitude):
        u = amplitude * jnp.asarray(drive(60))
        return jnp.sum(simulate(system, u, system.init())[1] ** 2)

    assert loss(0.0)[1] == 0.0
    near = (loss(2.0 + 1e-6)[0] - loss(2.0 - 1e-6)[0]) / 2e-6
    assert loss(2.0)[1] == pytest.approx(float(near), rel=1e-5)


ONE = StateSpace(*MATRICES[0], DT)
OTHER = StateSpace(*MATRICES[0], 2.0 * DT)


@pytest.mark.parametrize(
    ("models", "levels", "time_constant", "message"),
    [
        ((ONE,), (1.0,), 0.1, "1 models for 1 levels; there must be one model per"),
        ((ONE, ONE), (1.0,), 0.1, "2 models for 1 levels"),
        ((ONE, OTHER), (1.0, 2.0), 0.1, "models differ in .states, outputs"),
        ((ONE, ONE), (2.0, 1.0), 0.1, "a level is 2 and the next is 1"),
        ((ONE, ONE), (-1.0, 1.0), 0.1, "levels in V is -1; it must be .* at least 0"),
        ((ONE, ONE), (1.0, 2.0), 1e-4, "time constant in s is 0.0001; .* least 0.001"),
    ],
)
def test_bad_systems_are_refused(models, levels, time_constant, message):
    with pytest.raises(ValueError, match=message):
        AmplitudeScheduled(models, levels, time_constant)
