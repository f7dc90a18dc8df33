"""The nonlinear phase compensator against its describing function and a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.control import PID
from oracles.loop import closed_loop
from oracles.published import plant_t2

from piezojax import simulate
from piezojax.catalog import p753
from piezojax.control import PhaseCompensator
from piezojax.core.feedback import LoopInput, Observation
from piezojax.core.system import System

SHARE, THRESHOLD, SAMPLES = 0.3, 4.0, 2_000
GAINS = {"P": 0.5, "I": 3000.0, "D": 0.0}
GAINS |= {"derivative_filter": 1e-4, "anti_windup": 100.0}  # p753.pid
TIME = np.arange(SAMPLES + 1) / 20e3
BEYOND = 12.0 * (1.0 - np.cos(2.0 * np.pi * 30.0 * TIME))


class Passing(System):
    """A controller whose command is the reference."""

    def init(self, input):
        return ()

    def step(self, state, seen):
        return state, seen.reference


@jax.jit
def phased(controller, wave):
    def step(carry, v):
        state, applied = carry
        state, u = controller.step(state, Observation(v, v, v, applied))
        return (state, u), u

    zero = jnp.zeros(())
    start = controller.init(Observation(zero, zero, zero, zero))
    return jax.lax.scan(step, (start, zero), wave)[1]


@pytest.mark.parametrize("amplitude", [5.0, 10.0, 40.0])
def test_the_first_harmonic_equals_the_describing_function(amplitude):
    samples = 8_000
    turns = 2.0 * np.pi * np.arange(2 * samples) / samples
    u = phased(
        PhaseCompensator(Passing(), SHARE, THRESHOLD),
        jnp.asarray(amplitude * np.sin(turns)),
    )[samples:]
    found = 2j * np.mean(u * np.exp(-1j * turns[samples:])) / amplitude
    ratio = THRESHOLD / amplitude
    b = 1.0 - 2.0 * ratio
    play = 0.5 + (np.arcsin(b) + b * np.sqrt(1.0 - b**2)) / np.pi
    play = play - 4.0 / np.pi * ratio * (1.0 - ratio) * 1j
    expected = 1.0 + SHARE * (1.0 - play)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.angle(found) > 0.02


class Phased:
    """The PID of the oracles with a stop operator on its command."""

    def __init__(self):
        self.pid = PID(GAINS, 20e3)
        self.v = self.stop = 0.0

    def step(self, z, r_next, r, r_prev):
        self.wanted = self.pid.step(z, r_next, r, r_prev)
        moved = self.stop + self.wanted - self.v
        stop = min(max(moved, -THRESHOLD), THRESHOLD)
        return self.wanted + SHARE * stop

    def applied(self, u):
        # v with v + share stop(v) = u, by bisection.
        low, high = u - 1e3, u + 1e3
        for _ in range(80):
            v = 0.5 * (low + high)
            stop = min(max(self.stop + v - self.v, -THRESHOLD), THRESHOLD)
            low, high = (v, high) if v + SHARE * stop < u else (low, v)
        self.v, self.stop = v, stop
        self.pid.applied(v)


def test_a_saturated_loop_equals_the_equations():
    @jax.jit
    def run(loop, reference):
        inputs = LoopInput(reference[1:], jnp.zeros(SAMPLES))
        return simulate(loop, inputs, loop.init(0.0))[1]

    controller = PhaseCompensator(p753.pid(), SHARE, THRESHOLD)
    found = run(p753.loop(controller), jnp.asarray(BEYOND))
    expected = closed_loop(Phased(), BEYOND, plant_t2("trapezoid"), None)
    assert 0.05 < np.mean(expected["command"] != expected["voltage"]) < 0.9
    for column in ("displacement", "command"):
        np.testing.assert_allclose(
            getattr(found, column), expected[column], rtol=0.0, atol=1e-9
        )
