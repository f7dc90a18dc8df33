import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Record,
)
from piezojax.identification import (
    fit_neural_state_space,
    neural_start,
    steady_response,
)

SAMPLES = 256


def noise(columns, seed=0):
    return np.random.default_rng(seed).standard_normal((SAMPLES, columns))


def settled(step, inputs, order):
    """Return the last of five periods of y(k + 1) = step(state, u(k)), from zero."""
    state, outputs = np.zeros(order), []
    for u in np.tile(inputs, (5, 1)):
        state, output = step(state, u)
        outputs.append(output)
    return np.roll(outputs[-SAMPLES:], 1, axis=0)


def record(step, columns, order, seed=0, offset=0.0):
    inputs = noise(columns, seed) + offset
    outputs = settled(step, inputs, order)
    return Record(inputs, outputs, 1e-3, source="made", period=SAMPLES)


A = np.array([[0.8, 0.3, 0.0], [-0.3, 0.8, 0.1], [0.0, 0.0, 0.5]])
B = np.array([[1.0, 0.0], [0.2, 0.5], [0.0, 1.0]])
C = 1e-6 * np.array([[1.0, 0.0, 0.3], [0.0, 20.0, 1.0]])


def linear(state, u):
    state = A @ state + B @ u
    return state, C @ state + np.array([3e-6, 0.0])


def share(system, record):
    """Return the rms error of the settled response over the deviation of the output."""
    columns = record.inputs if record.inputs.shape[1] > 1 else record.input
    found = steady_response(system, jnp.asarray(columns), record.samples)
    error = np.asarray(found).reshape(record.outputs.shape) - record.outputs
    return np.sqrt(np.mean(error**2, axis=0)) / np.std(record.outputs, axis=0)


def test_start_equals_the_linear_system_of_the_record():
    start = neural_start(record(linear, 2, 3), 3, 4)
    for seed in (0, 1):
        fresh = record(linear, 2, 3, seed, offset=0.4)
        assert np.max(share(start, fresh)) < 1e-7
    np.testing.assert_allclose(
        np.sort(np.abs(np.linalg.eigvals(start.state_matrix))),
        np.sort(np.abs(np.linalg.eigvals(A))),
        rtol=1e-7,
    )


def test_start_is_stable_for_a_record_of_noise():
    rubbish = Record(noise(1), noise(1, 1), 1e-3, period=SAMPLES)
    start = neural_start(rubbish, 10, 1)
    assert np.max(np.abs(np.linalg.eigvals(start.state_matrix))) < 1.0


def bent(state, u):
    """Return a record of a saturating state, which no linear system represents."""
    state = 0.7 * state + np.tanh(2.0 * u[:1]) - 0.3 * np.tanh(3.0 * state)
    return state, 5.0 + 2.0 * state


def test_training_fits_a_loop_that_no_linear_model_fits():
    made = record(bent, 1, 1)
    # The first of three draws of four neurons ends in a poor minimum.
    fitted = fit_neural_state_space(made, 1, 4, starts=3, steps=60)
    fresh = record(bent, 1, 1, seed=1)
    assert np.max(share(neural_start(made, 1, 4), fresh)) > 0.1
    assert np.max(share(fitted, fresh)) < 1e-6


def test_seed_decides_the_start_and_the_model():
    made = record(bent, 1, 1)
    one, same, other = (neural_start(made, 1, 4, seed=seed) for seed in (3, 3, 4))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.neuron_state, other.neuron_state)


def test_several_inputs_and_outputs_are_trained_at_once():
    def saturating(state, u):
        state, output = linear(state, u)
        return state - 0.5 * np.tanh(2.0 * state), output

    made = record(saturating, 2, 3)
    fitted = fit_neural_state_space(made, 3, 6, steps=60)
    fresh = record(saturating, 2, 3, seed=1)
    assert np.max(share(neural_start(made, 3, 6), fresh)) > 0.1
    assert np.max(share(fitted, fresh)) < 0.02


def test_zero_starts_are_refused():
    with pytest.raises(ValueError, match="starts is 0; it must be at least 1"):
        fit_neural_state_space(record(bent, 1, 1), 1, 4, starts=0)


@pytest.mark.parametrize(
    ("order", "neurons", "message"),
    [
        (0, 4, r"order is 0; it must lie in 1\.\.24"),
        (25, 4, r"order is 25; it must lie in 1\.\.24"),
        (3, 0, "neurons is 0; it must be at least 1"),
    ],
)
def test_bad_sizes_are_refused(order, neurons, message):
    with pytest.raises(ValueError, match=message):
        fit_neural_state_space(record(linear, 2, 3), order, neurons)
