"""Iterative learning within a run, against trials in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import Feedback, loop_inputs, simulate
from piezojax.control import PID, LearningControl
from piezojax.core.system import Affine
from piezojax.dynamics import ARMA
from piezojax.hardware import Sensor

DT, PERIOD, TRIALS = 1e-3, 40, 12
P, INTEGRAL, NOISE = 0.2, 200.0, 0.003
GAIN, SMOOTHING, LEAD = 0.7, (0.2, 0.1), 3
TIME = np.arange(PERIOD * TRIALS)
REFERENCE = 1.0 - np.cos(2.0 * np.pi * TIME / PERIOD) + 0.3 * (TIME % PERIOD > 25)
DRAWS = np.random.default_rng(6).normal(size=TIME.size)


def controller(**changes):
    given = {"gain": GAIN, "period": PERIOD, "smoothing": SMOOTHING, "lead": LEAD}
    return LearningControl(PID(P, INTEGRAL, dt=DT), **(given | changes))


@jax.jit
def run(loop):
    inputs = loop_inputs(jnp.asarray(REFERENCE), jnp.asarray(DRAWS))
    return simulate(loop, inputs, loop.init(0.0))[1]


def trials():
    """Return y and u of the loop with corrections computed between the trials."""
    ends = lambda i: min(max(i, 0), PERIOD - 1)  # noqa: E731
    correction, y, total, outputs, commands = np.zeros(PERIOD), 0.0, 0.0, [], []
    for trial in range(TRIALS):
        e = np.zeros(PERIOD)
        for i in range(PERIOD):
            k = trial * PERIOD + i
            z = y + NOISE * DRAWS[k]
            e[i] = REFERENCE[k] - z
            total += INTEGRAL * DT * (e[i] + correction[i])
            u = P * (e[i] + correction[i]) + total
            outputs.append(y)
            commands.append(u)
            y = 0.5 * y + 0.5 * u
        wanted = [correction[i] + GAIN * e[ends(i + LEAD)] for i in range(PERIOD)]
        correction = np.array(wanted)
        for away, weight in enumerate(SMOOTHING, start=1):
            for i in range(PERIOD):
                beside = wanted[ends(i - away)] + wanted[ends(i + away)]
                correction[i] += weight * (beside - 2.0 * wanted[i])
    return np.array(outputs), np.array(commands)


def test_the_run_equals_the_trials_and_learns():
    loop = Feedback(controller(), ARMA((0.5,), (0.5,)), Affine(), Sensor(NOISE))
    found = run(loop)
    y, u = trials()
    np.testing.assert_allclose(found.displacement, y, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.command, u, rtol=0.0, atol=1e-9)
    rms = np.sqrt(np.mean((REFERENCE - y).reshape(TRIALS, PERIOD) ** 2, axis=1))
    assert rms[-1] < 0.5 * rms[0]


def test_a_period_shorter_than_the_preview_is_refused():
    with pytest.raises(ValueError, match=r"reach 40 samples ahead; .* the period, 40"):
        controller(lead=38)
