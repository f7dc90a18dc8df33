"""Iterative learning between trials, against matrices on a linear stage."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.catalog import p753, p753_survey
from piezojax.control import (
    LearningLaw,
    learn,
)
from piezojax.dynamics import (
    ARMA,
)
from piezojax.signals import waveforms as signals

SAMPLES, TRIALS = 80, 12
A, B = (1.2, -0.4), (0.05, 0.1, 0.05)
STAGE = ARMA(A, B)
REFERENCE = 2.0 * (1.0 - np.cos(2.0 * np.pi * np.arange(SAMPLES) / SAMPLES))
REFERENCE[40:50] += 0.5
WANTED = jnp.asarray(REFERENCE)

LAWS = {
    "gain alone": LearningLaw(0.6),
    "with lead": LearningLaw(0.8, lead=2),
    "with filter": LearningLaw(0.8, (0.2, 0.1), lead=2),
}


def response_matrix():
    """Return G from u(0), u(1), ... to y, at rest under u(0) before."""
    y = np.zeros((SAMPLES + 500, SAMPLES))
    u = np.eye(SAMPLES)
    u = np.concatenate([np.repeat(u[:1], 500, axis=0), u])
    for k in range(2, len(y)):
        y[k] = A[0] * y[k - 1] + A[1] * y[k - 2]
        y[k] += B[0] * u[k] + B[1] * u[k - 1] + B[2] * u[k - 2]
    return y[500:]


def law_matrices(law):
    """Return L and Q, both with repeated ends."""
    rows = np.arange(SAMPLES)
    ends = lambda i: np.clip(i, 0, SAMPLES - 1)  # noqa: E731
    lead = np.zeros((SAMPLES, SAMPLES))
    np.add.at(lead, (rows, ends(rows + law.lead)), float(law.gain))
    smooth = np.zeros((SAMPLES, SAMPLES))
    weights = [float(weight) for weight in law.smoothing]
    np.add.at(smooth, (rows, rows), 1.0 - 2.0 * sum(weights))
    for away, weight in enumerate(weights, start=1):
        for side in (-away, away):
            np.add.at(smooth, (rows, ends(rows + side)), weight)
    return lead, smooth


@jax.jit
def learned(law, start):
    return learn(law, STAGE, WANTED, TRIALS, feedforward=start)


@pytest.mark.parametrize("name", LAWS)
def test_trials_equal_the_matrices_and_contract(name):
    law = LAWS[name]
    stage = response_matrix()
    lead, smooth = law_matrices(law)
    start = np.random.default_rng(4).normal(size=SAMPLES)
    found = learned(law, jnp.asarray(start))

    u, errors, inputs = start, [], [start]
    for _ in range(TRIALS):
        errors.append(REFERENCE - stage @ u)
        u = smooth @ (u + lead @ errors[-1])
        inputs.append(u)
    np.testing.assert_allclose(found.feedforward, u, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.error, errors[-1], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        found.rms_error, np.sqrt(np.mean(np.square(errors), axis=1)), rtol=1e-9
    )

    if name == "with lead":
        return  # the first errors are never used: the fixed point is not unique

    # closed form: a fixed point, and powers of a matrix that converge to it
    step = smooth @ (np.eye(SAMPLES) - lead @ stage)
    fixed = np.linalg.solve(np.eye(SAMPLES) - step, smooth @ lead @ REFERENCE)
    closed = fixed + np.linalg.matrix_power(step, TRIALS) @ (start - fixed)
    np.testing.assert_allclose(found.feedforward, closed, rtol=0.0, atol=1e-9)
    if name == "with filter":
        norm = np.linalg.norm(step, 2)
        assert norm < 1.0
        distances = [np.linalg.norm(u - fixed) for u in inputs]
        assert np.all(np.array(distances[1:]) <= norm * np.array(distances[:-1]))


def test_the_frequency_condition_separates_growth_from_decay():
    z = np.exp(1j * np.linspace(1e-3, np.pi, 500))
    stage = (B[0] + B[1] / z + B[2] / z**2) / (1.0 - A[0] / z - A[1] / z**2)

    def largest(law):
        smooth = 1.0 + sum(
            2.0 * float(weight) * (np.cos(np.angle(z) * away) - 1.0)
            for away, weight in enumerate(law.smoothing, start=1)
        )
        return np.abs(smooth * (1.0 - float(law.gain) * z**law.lead * stage)).max()

    good, bad = LAWS["with filter"], LearningLaw(4.0, (0.1,), lead=0)
    assert largest(good) < 1.0 < largest(bad)
    start = jnp.zeros(SAMPLES)
    assert learned(good, start).rms_error[-1] < 0.1 * learned(good, start).rms_error[0]
    assert learned(bad, start).rms_error[-1] > learned(bad, start).rms_error[0]


def test_learning_reduces_the_error_of_a_hysteretic_stage_with_noise():
    reference = signals.sine(signals.time_grid(0.1, p753.RATE), 10.0)
    draws = jnp.asarray(np.random.default_rng(6).normal(size=(8, reference.size)))
    trials = jax.jit(lambda law, loop: learn(law, loop, reference, 8, draws))
    found = trials(p753_survey.learning(), p753.loop(p753.pid()))
    first, last = found.rms_error[0], found.rms_error[-1]
    assert first > 0.5
    assert last < 0.03
    np.testing.assert_allclose(last, np.sqrt(np.mean(found.error**2)), rtol=1e-12)
    assert found.feedforward.shape == reference.shape


def test_gradients_equal_finite_differences_and_finite_for_a_perfect_trial():
    law = LAWS["with filter"]

    def loss(gain, weight, stage_b, reference):
        law = LearningLaw(gain, (weight, 0.1), lead=2)
        stage = ARMA(A, (stage_b, *B[1:]))
        return learn(law, stage, reference, 3).rms_error[-1]

    slopes = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2)))
    values = np.array([0.8, 0.2, 0.05])
    _, found = slopes(*values, WANTED)
    for i, slope in enumerate(found):
        move = 1e-6 * (np.arange(3) == i)
        sides = [slopes(*(values + t * move), WANTED)[0] for t in (1, -1)]
        np.testing.assert_allclose(slope, (sides[0] - sides[1]) / 2e-6, rtol=1e-6)
    value, found = slopes(*values, jnp.zeros(SAMPLES))
    assert value == 0.0
    assert np.all(np.array(found) == 0.0)
    np.testing.assert_array_equal(law.next(jnp.ones(9), jnp.zeros(9)), np.ones(9))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LearningLaw(np.nan), "gain .* is nan; .* finite"),
        (lambda: LearningLaw(1.0, (np.inf,)), "smoothing is inf; .* finite"),
        (lambda: LearningLaw(1.0, (), -1), "lead in samples is -1; .* at least 0"),
        (
            lambda: learn(LAWS["gain alone"], STAGE, WANTED, 0),
            "trials is 0; .* at least 1",
        ),
        (
            lambda: learn(
                LAWS["gain alone"], STAGE, WANTED, 3, jnp.zeros((2, SAMPLES))
            ),
            r"have the shapes \(80,\), \(80,\) and \(2, 80\); .* \(3, samples\)",
        ),
    ],
)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
