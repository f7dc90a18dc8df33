"""Low-pass of analogue electronics against SciPy and a held input."""

import jax
import numpy as np
import pytest
from scipy import signal

from piezojax import simulate
from piezojax.dynamics import AnalogLowPass, linearise

DT = 5e-5
INPUT = np.random.default_rng(0).normal(size=200)


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def discrete(order, bandwidth, method):
    analog = signal.butter(order, 2.0 * np.pi * bandwidth, analog=True, output="zpk")
    return signal.cont2discrete(signal.zpk2ss(*analog), DT, method)[:4]


def stepped(matrices, inputs, start):
    """Return the outputs of ``matrices`` from rest, in a plain loop."""
    A, B, C, D = matrices
    state = np.linalg.solve(np.eye(len(A)) - A, B[:, 0] * start)
    outputs = []
    for value in inputs:
        outputs.append((C @ state + D[:, 0] * value)[0])
        state = A @ state + B[:, 0] * value
    return np.array(outputs)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_a_low_pass_is_exact_for_an_input_that_is_linear_between_samples(order):
    """One cut-off is far below the rate, one above the Nyquist frequency."""
    for bandwidth in (3.0, 900.0, 4e4):
        expected = stepped(discrete(order, bandwidth, "foh"), INPUT, 0.7)
        found = response(AnalogLowPass(bandwidth, DT, order), INPUT, 0.7)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


def test_a_held_input_gives_the_mean_over_the_sample():
    fine = 200
    A, B, C, D = signal.cont2discrete(
        signal.zpk2ss(*signal.butter(2, 2e4, analog=True, output="zpk")), DT / fine
    )[:4]
    inside = stepped((A, B, C, D), np.repeat(INPUT, fine), 0.0)
    ends = np.append(inside[1:], inside[-1])
    mean = 0.5 * (inside + ends).reshape(-1, fine).mean(axis=1)
    found = response(AnalogLowPass(2e4 / (2.0 * np.pi), DT, 2), INPUT, 0.0)
    # The sample before the first one is at rest.
    np.testing.assert_allclose(found[:-1], mean[:-1], atol=2e-5)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_gain_and_poles(order):
    bandwidth = 30.0
    model = linearise(AnalogLowPass(bandwidth, DT, order))
    response = model.frequency_response(np.array([0.0, bandwidth]))
    gain = np.abs(np.asarray(response)[:, 0, 0])
    np.testing.assert_allclose(gain, [1.0, np.sqrt(0.5)], rtol=1e-4)
    poles = np.linalg.eigvals(np.asarray(model.A))
    expected = np.linalg.eigvals(discrete(order, bandwidth, "foh")[0])
    moved = np.abs(poles) > 1e-9  # the stored last input is a state with a pole at 0
    assert moved.sum() == order
    for pole in expected:
        assert np.abs(poles[moved] - pole).min() < 1e-6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, DT), "bandwidth in Hz is 0; it must be finite and at least 0.001"),
        ((2e9, DT), r"bandwidth in Hz is 2e\+09; .* at most 1e\+09"),
        ((100.0, 0.0), "dt in s is 0"),
        ((100.0, DT, 0), "order is 0; .* at least 1"),
        ((100.0, DT, 5), "order is 5; .* at most 4"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(ValueError, match=message):
        AnalogLowPass(*arguments)
