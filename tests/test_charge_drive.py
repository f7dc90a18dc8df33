"""The charge amplifier against (2.12), and with a hysteretic load."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.hysteresis import inverse_trapezoid_step
from oracles.published import HYSTERESIS, KE, T2_G, T2_P
from scipy.signal import lfilter

from piezojax import (
    Feedback,
    loop_inputs,
    simulate,
)
from piezojax.catalog import p753, p753_survey
from piezojax.core.system import Affine
from piezojax.hardware import (
    ChargeDrive,
    Sensor,
)
from piezojax.signals import waveforms as signals

DT = 5e-5
LOAD = p753_survey.charge_drive().load


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


@cache
def rest():
    """Return the hysteretic drive at rest at 0 V, for any gain and time constants."""
    return jax.jit(lambda drive: drive.init(0.0))(p753_survey.charge_drive())


@jax.jit
def after(state, drive, inputs):
    return simulate(drive, inputs, state)[1]


@pytest.mark.parametrize("frequency", [0.05, 0.5, 5.0, 50.0])
def test_a_linear_load_has_the_printed_transfer_function(frequency):
    drive = ChargeDrive(Affine(), 0.8, 0.2, 0.5, 1e-3)
    w = 2.0 * np.pi * frequency
    period = round(1e3 / frequency)
    samples = period * max(1, round(10e3 / period))
    turns = jnp.exp(-1j * w * 1e-3 * jnp.arange(samples))
    tone = jnp.asarray(jnp.conj(turns).real)
    # Transients decay with exp(-t / 0.5 s): the second run has none.
    found = response(drive, jnp.concatenate([tone, tone]))[samples:]
    found = 2.0 * (found * turns).mean()
    # C_s (s + 1 / C_s R_s) / (s + 1 / C_L R_L), over C_L.
    expected = 0.8 * (1j * w + 5.0) / (1j * w + 2.0)
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_equal_time_constants_give_a_gain():
    inputs = np.cumsum(np.random.default_rng(1).normal(size=2_000))
    drive = ChargeDrive(Affine(), 0.7, 0.1, 0.1, DT)
    np.testing.assert_allclose(
        response(drive, jnp.asarray(inputs)), 0.7 * inputs, rtol=0.0, atol=1e-9
    )


def test_a_hysteretic_load_equals_the_equations():
    drive = ChargeDrive(LOAD, 1.1, 0.02, 0.025, DT)
    time = DT * np.arange(20_000)
    inputs = 25.0 * (1.0 - np.cos(2 * np.pi * 7.0 * time)) + 5.0 * np.sin(200.0 * time)
    found = after(rest(), drive, jnp.asarray(inputs))
    charge = v = u = f = 0.0
    expected = []
    for value in inputs:
        charge += 1.1 * (value - v) + DT * (1.1 * v / 0.02 - u / 0.025)
        u = inverse_trapezoid_step(f, u, KE * charge, *HYSTERESIS)
        f, v = KE * charge, value
        expected.append(u)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    assert np.ptp(expected) > 40.0


def loop_width(corner_time):
    """Return the width of the loop at 10 Hz, in % of its stroke."""
    drive = ChargeDrive(LOAD, 1.0, corner_time, corner_time, DT)
    command = signals.sine(signals.time_grid(0.3, p753.RATE), 10.0, 30.0)
    y = response(p753.hysteresis(), after(rest(), drive, command))[-2_000:]
    rising, falling = y[:1_000], y[1_000:][::-1]
    return 100.0 * np.abs(rising - falling).max() / np.ptp(y)


def test_charge_control_removes_hysteresis_above_its_corner_only():
    charge, voltage = loop_width(1.0), loop_width(5e-4)  # 0.16 and 320 Hz
    assert voltage > 8.0
    assert charge < 0.11 * voltage  # the 89 % of section 2.5.1


def test_a_loop_with_a_charge_drive_stays_at_rest():
    @jax.jit
    def run(reference):
        loop = Feedback(
            p753.pid(), p753.plant(), p753_survey.charge_drive(), Sensor(p753.NOISE_RMS)
        )
        return simulate(loop, loop_inputs(reference), loop.init(reference[0]))[1]

    for level in (0.0, 5.0):
        samples = run(jnp.full(200, level))
        np.testing.assert_allclose(samples.displacement, level, rtol=0.0, atol=1e-7)


def test_gradients_equal_finite_differences_and_are_finite_at_rest():
    command = signals.sine(signals.time_grid(0.02, p753.RATE), 100.0, 20.0)
    start = rest()

    def loss(times, command):
        return simulate(ChargeDrive(LOAD, *times, DT), command, start)[1][-1]

    slopes = jax.jit(jax.value_and_grad(loss))
    times = jnp.asarray([1.0, 0.9, 1.2])
    _, found = slopes(times, command)
    for i in range(3):
        move = 1e-5 * (jnp.arange(3) == i)
        sides = [slopes(times + t * move, command)[0] for t in (1, -1)]
        np.testing.assert_allclose(found[i], (sides[0] - sides[1]) / 2e-5, rtol=1e-5)
    value, found = slopes(times, jnp.zeros_like(command))
    assert value == 0.0
    np.testing.assert_array_equal(found, 0.0)


def test_at_rest_the_output_is_the_static_gain():
    drive = ChargeDrive(LOAD, 0.8, 0.2, 0.5, DT)
    held = response(drive, jnp.full(100, 10.0))
    np.testing.assert_allclose(held, 0.8 * 0.5 / 0.2 * 10.0, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 1.0, 1.0, DT), "gain is 0; .* above 0"),
        ((1.0, -1.0, 1.0, DT), "source_time in s is -1; .* above 0"),
        ((1.0, 1.0, np.inf, DT), "load_time in s is inf"),
        ((1.0, 1.0, 1.0, 0.0), "dt in s is 0; .* above 0"),
    ],
)
def test_bad_parameters_are_refused(arguments, message):
    *values, dt = arguments
    with pytest.raises(ValueError, match=message):
        ChargeDrive(Affine(), *values, dt)


def test_the_catalogued_stage_follows_the_charge():
    # The hysteresis of the stage cancels that of the load: the charge moves the stage.
    stage = p753_survey.charge_driven_stage()
    time = DT * np.arange(4_000)
    inputs = 30.0 * (1.0 - np.cos(2.0 * np.pi * 20.0 * time))
    found = response(stage, jnp.asarray(inputs))
    charge = v = u = f = 0.0
    force = []
    for value in inputs:
        charge += value - v + DT * (v - u) / p753_survey.CHARGE_TIME
        u = inverse_trapezoid_step(f, u, KE * charge, *HYSTERESIS)
        f, v = KE * charge, value
        force.append(f)
    (a1, a2), b = T2_P, T2_G
    expected = lfilter(b, [1.0, -a1, -a2], force)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    assert np.ptp(expected) > 5.0
