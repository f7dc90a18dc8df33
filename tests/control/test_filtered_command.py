"""A filtered command against a plain PID loop with the notch of SciPy."""

import jax
import numpy as np
import scipy.signal
from oracles import control as oracle

from piezojax import simulate
from piezojax.control import PID, FilteredCommand
from piezojax.core.feedback import Observation
from piezojax.core.system import Affine
from piezojax.dynamics import Notch, SecondOrderLowPass

DT = 5e-5
GAINS = {
    "P": 0.5,
    "I": 3000.0,
    "D": 1e-5,
    "derivative_filter": 1e-4,
    "anti_windup": 700.0,
}
SAMPLES = 400
RANDOM = np.random.default_rng(11)
MEASURED = RANDOM.normal(size=SAMPLES)
REFERENCE = 2.0 * np.sin(0.02 * np.arange(SAMPLES))
LIMIT = 0.8
"""Limit of the actuator (V), which most commands exceed."""


def pid():
    return PID(*GAINS.values(), dt=DT)


@jax.jit
def run(controller):
    """Return the commands of ``controller`` before an actuator with limits."""

    def step(state, input):
        inner, applied = state
        reference, measured = input
        seen = Observation(reference, reference, measured, applied)
        inner, command = controller.step(inner, seen)
        return (inner, command.clip(-LIMIT, LIMIT)), command

    start = controller.init(Observation(0.0, 0.0, 0.0, 0.0))
    return jax.lax.scan(step, (start, 0.0), (REFERENCE, MEASURED))[1]


def test_the_command_is_the_pid_followed_by_the_notch():
    b, a = scipy.signal.iirnotch(3000.0, 1.5, 1.0 / DT)
    # The notch of SciPy with tan(width / 2) = damping sin(angle).
    angle = 2.0 * np.pi * 3000.0 * DT
    damping = np.tan(0.5 * angle / 1.5) / np.sin(angle)
    found = run(FilteredCommand(pid(), Notch(3000.0, damping, 0.0, DT)))
    plain, state, expected = oracle.PID(GAINS, 1.0 / DT), np.zeros(2), []
    for k in range(SAMPLES):
        before = REFERENCE[max(k - 1, 0)]
        wanted = plain.step(MEASURED[k], None, REFERENCE[k], before)
        (filtered,), state = scipy.signal.lfilter(b, a, [wanted], zi=state)
        expected.append(filtered)
        # The anti-windup responds to the limits alone, not to the notch.
        plain.applied(plain.command + np.clip(filtered, -LIMIT, LIMIT) - filtered)
    assert np.mean(np.abs(found) > LIMIT) > 0.2
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_an_all_pass_filter_changes_nothing():
    alone, filtered = run(pid()), run(FilteredCommand(pid(), Affine()))
    np.testing.assert_allclose(filtered, alone, rtol=0.0, atol=1e-12)


def test_filters_in_series_equal_one_filter():
    both = Notch(3000.0, 0.5, 0.1, DT) >> SecondOrderLowPass(5000.0, 0.7, DT)
    controller = FilteredCommand(pid(), both)
    resting = Observation(*np.full((4, 5), [[1.0], [1.0], [1.0], [7.0]]))
    first = jax.tree.map(lambda signal: signal[0], resting)
    commands = simulate(controller, resting, controller.init(first))[1]
    np.testing.assert_allclose(commands, 7.0, rtol=0.0, atol=1e-12)
    one, other = (run(FilteredCommand(pid(), part)) for part in both.parts)
    together = run(controller)
    assert np.ptp(together - one) > 0.01 < np.ptp(together - other)
