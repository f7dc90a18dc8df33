"""A controller with a limited reference against a NumPy loop and a linear program."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import control as oracle
from scipy.optimize import linprog
from scipy.signal import cont2discrete, dlsim

from piezojax.control import PID, LimitedReference
from piezojax.core.feedback import Observation
from piezojax.core.parameter import sample_time
from piezojax.core.system import System

DT, SLEW, ACCELERATION = 1e-3, 40.0, 8e3
GAINS = {"P": 0.5, "I": 30.0, "D": 0.0, "derivative_filter": 1e-2, "anti_windup": 50.0}
MEASURED = np.random.default_rng(4).normal(size=1000)


def pid():
    return PID(*GAINS.values(), dt=DT)


@jax.jit
def run(controller, reference):
    """Return the commands of ``controller``, which are applied without limits."""

    def step(state, input):
        inner, applied = state
        reference, following, measured = input
        seen = Observation(reference, following, measured, applied)
        inner, command = controller.step(inner, seen)
        return (inner, command), command

    start = controller.init(Observation(*[reference[0]] * 3, 0.0))
    signals = reference[:-1], reference[1:], MEASURED[: len(reference) - 1]
    return jax.lax.scan(step, (start, 0.0), signals)[1]


def limited(reference):
    """Return ``reference`` with changes of at most SLEW DT per sample."""
    found = [reference[0]]
    for wanted in reference[1:]:
        found.append(found[-1] + np.clip(wanted - found[-1], -SLEW * DT, SLEW * DT))
    return np.array(found)


def test_the_controller_sees_jumps_as_ramps():
    wanted = np.r_[np.full(20, 1.0), np.full(150, 3.0), np.full(100, 2.5)]
    seen = limited(wanted)
    # The ramp takes 2 um / (40 um/s) = 50 samples.
    assert seen[19] == 1.0 < seen[20] < seen[68] < 3.0 == pytest.approx(seen[70])
    plain, expected, before = oracle.PID(GAINS, 1.0 / DT), [], seen[0]
    for k in range(len(seen) - 1):
        expected.append(plain.step(MEASURED[k], None, seen[k], before))
        plain.applied(expected[-1])
        before = seen[k]
    found = run(LimitedReference(pid(), SLEW, DT), wanted)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)


def test_references_below_the_slew_pass_as_they_are():
    reference = 2.0 * np.sin(0.9 * SLEW / 2.0 * DT * np.arange(300))
    found = run(LimitedReference(pid(), SLEW, DT), reference)
    np.testing.assert_array_equal(found, run(pid(), reference))


class Seen(System):
    """Controller whose command is the next reference that it sees."""

    dt: float = sample_time()

    def init(self, input):
        return ()

    def step(self, state, input):
        return state, input.next_reference


def smooth(reference, slew=SLEW, acceleration=ACCELERATION):
    """Return ``reference`` as a controller sees it behind both limits."""
    controller = LimitedReference(Seen(DT), slew, DT, acceleration)
    return np.r_[reference[0], run(controller, reference)]


def test_references_below_both_limits_pass_as_they_are():
    # 2 um at the frequency whose acceleration is 0.9 times the limit; at rest at first.
    omega = np.sqrt(0.9 * ACCELERATION / 2.0)
    time = DT * np.arange(300)
    reference = 3.0 - 2.0 * np.cos(omega * time)
    fast = 3.0 * SLEW  # the slew is 2 omega = 120 um/s at most
    np.testing.assert_allclose(smooth(reference, fast), reference, rtol=0.0, atol=1e-12)
    slow = smooth(reference, fast, 0.5 * ACCELERATION)
    assert np.abs(slow - reference).max() > 0.1


def fewest(height):
    """Return the fewest samples of a motion from rest to rest within both limits.

    A linear program finds the highest motion of each number of samples.
    """
    most, fastest = ACCELERATION * DT**2, SLEW * DT
    for count in range(1, 1000):
        # Each change differs by at most ``most`` from the one before; 0 at both ends.
        apart = np.eye(count + 1, count) - np.eye(count + 1, count, -1)
        found = linprog(
            -np.ones(count),
            np.vstack([apart, -apart]),
            np.full(2 * (count + 1), most),
            bounds=(-fastest, fastest),
        )
        if -found.fun >= height - 1e-9:
            return count
    raise AssertionError(f"no motion of {height} um")


@pytest.mark.parametrize("height", [0.005, 0.0081, 0.05, 0.2, 0.7, -1.3, -3.0])
def test_a_jump_takes_the_fewest_samples(height):
    at = 5
    seen = smooth(np.r_[np.zeros(at), np.full(200, height)])
    arrived = np.flatnonzero(np.abs(seen - height) < 1e-9)[0]
    assert arrived == at - 1 + fewest(abs(height))
    np.testing.assert_allclose(seen[arrived:], height, rtol=0.0, atol=1e-12)
    # On its way it neither turns nor passes the end.
    assert np.all(np.diff(seen) * np.sign(height) >= -1e-12)


@given(st.integers(0, 10**6))
def test_no_reference_exceeds_the_limits(seed):
    random = np.random.default_rng(seed)
    jumps = np.repeat(random.normal(size=10), random.multinomial(200, np.full(10, 0.1)))
    reference = jumps + 0.3 * np.sin(0.2 * np.arange(len(jumps)))
    seen = smooth(np.r_[reference, np.full(400, reference[-1])])
    changes = np.r_[0.0, np.diff(seen)]
    assert np.abs(changes).max() <= SLEW * DT + 1e-12
    assert np.abs(np.diff(changes)).max() <= ACCELERATION * DT**2 + 1e-12
    assert seen[-1] == pytest.approx(reference[-1], abs=1e-12)


def test_the_motion_may_begin_anywhere_and_reach_a_moving_reference():
    # A ramp at half the slew that begins 1 um away is reached and then followed.
    reference = 1.0 + 0.5 * SLEW * DT * np.arange(400)
    seen = smooth(np.r_[np.zeros(5), reference])[5:]
    np.testing.assert_allclose(seen[200:], reference[200:], rtol=0.0, atol=1e-12)
    assert np.all(seen <= reference + 1e-12)


def test_a_mode_rings_less_behind_the_limit_of_the_acceleration():
    """Amplitudes of docs/goals.md, on an undamped mode of 20 Hz held by SciPy."""
    omega = 2.0 * np.pi * 20.0
    acceleration, count = 0.5 * SLEW * omega / np.pi, 900
    matrices = [[0.0, omega], [-omega, 0.0]], [[0.0], [omega]], [[1.0, 0.0]], [[0.0]]
    mode = cont2discrete(tuple(map(np.array, matrices)), DT)

    def ringing(height, acceleration):
        seen = smooth(np.r_[0.0, np.full(count, height)], SLEW, acceleration)
        _, y, _ = dlsim(mode, seen)
        return np.abs(y[-200:, 0] - height).max()

    # The worst height of a ramp: its corners are half a period of the mode apart.
    worst = SLEW * np.pi / omega
    assert ringing(worst, 1e12) == pytest.approx(2.0 * SLEW / omega, rel=0.02)
    bound = 4.0 * acceleration / omega**2
    assert bound < 0.33 * 2.0 * SLEW / omega
    found = [ringing(h, acceleration) for h in np.linspace(0.2, 2.5, 24) * worst]
    assert 0.7 * bound < max(found) < 1.02 * bound


def test_a_slew_of_zero_is_refused():
    with pytest.raises(ValueError, match="slew"):
        LimitedReference(pid(), 0.0, DT)
    with pytest.raises(ValueError, match="acceleration"):
        LimitedReference(pid(), SLEW, DT, 0.0)
