"""Ultimate gain, relay and rules, on stages with closed-form answers."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Feedback,
    System,
)
from piezojax.catalog import p753_by_rate
from piezojax.core.feedback import Observation
from piezojax.core.system import Delay, Series
from piezojax.hardware import (
    Saturation,
    Sensor,
)
from piezojax.solve.clock import Clock
from piezojax.tuning.baselines import Ultimate
from piezojax.tuning.baselines.experiments import (
    Relay,
    cycle_of,
    period_of,
    ultimate_by_gain,
    ultimate_by_relay,
)
from piezojax.tuning.baselines.rules import TYREUS_LUYBEN, ZIEGLER_NICHOLS

DT, RISE, LATE = 1e-3, 50.0, 4


class Level(NamedTuple):
    level: jnp.ndarray


class Integrator(System):
    """``y(k+1) = y(k) + rise dt u(k)``; at rest at 0 V, wherever it is."""

    rise: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    def init(self, input=0.0):
        return Level(jnp.zeros(()))

    def step(self, state, input):
        level = state.level + self.rise * self.dt * input
        return Level(level), level


class Lag(System):
    """``y(k+1) = p y(k) + (1 - p) gain u(k)``."""

    pole: float = eqx.field(static=True)
    gain: float = eqx.field(static=True)

    def init(self, input=0.0):
        return Level(self.gain * jnp.asarray(input, float))

    def step(self, state, input):
        level = self.pole * state.level + (1.0 - self.pole) * self.gain * input
        return Level(level), level


def loop_of(plant, noise=0.0):
    stage = Series((Delay(LATE), plant))
    return Feedback(plant, stage, Saturation(-100.0, 100.0), Sensor(noise))


def integrating():
    """Return gain and period: z^L (z - 1) = -K k dt at the angle pi/(2 L + 1)."""
    angle = np.pi / (2 * LATE + 1)
    gain = 2.0 * np.sin(0.5 * angle) / (RISE * DT)
    return loop_of(Integrator(RISE, DT)), gain, 2.0 * np.pi / angle * DT


def lagging():
    """Return gain and period: z^L (z - p) = -K g (1 - p) at phase pi, by bisection."""
    pole, static = 0.9, 0.4
    low, high = 1e-6, np.pi / LATE
    for _ in range(200):
        angle = 0.5 * (low + high)
        turn = LATE * angle + np.angle(np.exp(1j * angle) - pole)
        low, high = (angle, high) if turn < np.pi else (low, angle)
    gain = np.abs(np.exp(1j * angle) - pole) / (static * (1.0 - pole))
    return loop_of(Lag(pole, static)), gain, 2.0 * np.pi / angle * DT


STAGES = {"integrator": integrating, "lag": lagging}


@pytest.mark.parametrize("name", STAGES)
def test_the_ultimate_gain_and_period_equal_the_closed_form(name):
    loop, gain, period = STAGES[name]()
    found = ultimate_by_gain(
        loop, step=0.1, span=200.0, dt=DT, samples=4000, clock=Clock()
    )
    assert found.gain == pytest.approx(gain, rel=1e-3)
    assert found.period == pytest.approx(period, rel=1e-3)


@pytest.mark.parametrize("name", STAGES)
def test_the_relay_gives_nearly_the_same(name):
    loop, gain, period = STAGES[name]()
    found = ultimate_by_relay(
        loop, height=5.0, hysteresis=0.0, dt=DT, noise=np.zeros(4000), clock=Clock()
    )
    # The describing function omits harmonics; the period has whole samples.
    assert found.gain == pytest.approx(gain, rel=0.15)
    assert found.period == pytest.approx(period, rel=0.15)


def switching(noise, hysteresis, height=5.0):
    """Return the limit cycle of a relay with delay and integrator, in a plain loop."""
    line, level, side, sides, seen = [0.0] * LATE, 0.0, 1.0, [], []
    for draw in noise:
        measured = level + draw
        if abs(measured) > hysteresis:
            side = -1.0 if measured > 0.0 else 1.0
        line.append(height * side)
        level += RISE * DT * line.pop(0)
        sides.append(side)
        seen.append(measured)
    return np.array(sides), np.array(seen)


@pytest.mark.parametrize(("noise_rms", "hysteresis"), [(0.0, 0.01), (0.02, 0.06)])
def test_the_relay_equals_a_plain_loop(noise_rms, hysteresis):
    draws = np.random.default_rng(0).standard_normal(4000)
    found = ultimate_by_relay(
        loop_of(Integrator(RISE, DT), noise_rms),
        height=5.0,
        hysteresis=hysteresis,
        dt=DT,
        noise=draws,
        clock=Clock(),
    )
    sides, seen = switching(noise_rms * draws, hysteresis)
    sides, seen = sides[2000:], seen[2000:]
    rises = np.flatnonzero(np.diff(sides) > 0.0) + 1
    assert found.period == pytest.approx(np.mean(np.diff(rises)) * DT, rel=1e-9)
    if noise_rms == 0.0:
        length = rises[1] - rises[0]
        one = seen[rises[0] : rises[1]]
        amplitude = 2.0 / length * abs(np.fft.fft(one)[1])
        assert found.gain == pytest.approx(20.0 / (np.pi * amplitude), rel=1e-9)


def test_the_rules_equal_their_published_tables():
    """K_u = 8 V/um, T_u = 0.4 ms, by the tables of the papers."""
    ultimate = Ultimate(8.0, 4e-4)
    pi = ZIEGLER_NICHOLS["PI"].pid(ultimate, 1e-5)
    assert float(pi.proportional) == pytest.approx(3.6)
    assert float(pi.integral) == pytest.approx(3.6 * 1.2 / 4e-4)
    assert float(pi.derivative) == 0.0
    pid = ZIEGLER_NICHOLS["PID"].pid(ultimate, 1e-5)
    assert float(pid.proportional) == pytest.approx(4.8)
    assert float(pid.integral) == pytest.approx(4.8 / 2e-4)
    assert float(pid.derivative) == pytest.approx(4.8 * 5e-5)
    slow = TYREUS_LUYBEN["PID"].pid(ultimate, 1e-5)
    assert float(slow.proportional) == pytest.approx(8.0 / 2.2)
    assert float(slow.integral) == pytest.approx(8.0 / 2.2 / 8.8e-4)
    assert float(slow.derivative) == pytest.approx(8.0 / 2.2 * 4e-4 / 6.3)


def test_the_catalogued_rule_equals_this_rule():
    for rate, ultimate in p753_by_rate.ULTIMATE.items():
        known = p753_by_rate.ziegler_nichols(rate)
        found = ZIEGLER_NICHOLS["PI"].pid(Ultimate(*ultimate), 1.0 / rate)
        assert float(found.proportional) == pytest.approx(float(known.proportional))
        assert float(found.integral) == pytest.approx(float(known.integral))


def test_period_between_samples():
    time = np.arange(4000) * DT
    for period in (7.3e-3, 0.1, 2 * DT):
        wave = np.sin(2.0 * np.pi * time / period + 0.3)
        assert period_of(wave, DT) == pytest.approx(period, rel=1e-3)


def test_amplitude_of_a_cycle_with_harmonics():
    phase = 2.0 * np.pi * np.arange(4000) / 20
    switched = np.sign(np.sin(phase + 1e-6))
    wave = 0.3 * np.sin(phase + 1.0) + 0.1 * np.sin(3.0 * phase) + 5.0
    amplitude, period = cycle_of(wave, switched, DT)
    assert amplitude == pytest.approx(0.3, rel=1e-9)
    assert period == pytest.approx(20 * DT, rel=1e-9)


def test_a_relay_does_not_switch_within_its_hysteresis():
    relay = Relay(2.0, 0.5)

    def seen(error):
        return Observation(*(jnp.asarray(x) for x in (error, error, 0.0, 10.0)))

    state, commands = relay.init(seen(0.0)), []
    for error in (0.0, 0.4, -0.4, -0.6, -0.4, 0.4, 0.6):
        state, command = relay.step(state, seen(error))
        commands.append(float(command))
    assert commands == [12.0, 12.0, 12.0, 8.0, 8.0, 8.0, 12.0]


def test_bad_input():
    with pytest.raises(ValueError, match="height of the relay in V"):
        Relay(0.0)
    with pytest.raises(ValueError, match="hysteresis of the relay in um"):
        Relay(1.0, -1.0)
    with pytest.raises(ValueError, match="ultimate gain in V/um"):
        ZIEGLER_NICHOLS["PI"].pid(Ultimate(0.0, 1.0), DT)
    with pytest.raises(ValueError, match="ultimate period in s"):
        ZIEGLER_NICHOLS["PI"].pid(Ultimate(1.0, -1.0), DT)
    with pytest.raises(ValueError, match="no oscillation: 0 periods in 100 samples"):
        period_of(np.ones(100), DT)
    stage = loop_of(Lag(0.9, 0.4))
    with pytest.raises(ValueError, match="oscillates at none of the gains"):
        ultimate_by_gain(stage, step=0.1, span=1e-4, dt=DT, samples=400, clock=Clock())
