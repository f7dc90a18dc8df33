"""The loops of the benchmark of growth, by the number that grows."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from engines import DOB_PID_SMC, NOMINAL_GAINS
from piezojax_engine import LOOPS, signals

from piezojax.catalog import p558, p558_control, p753
from piezojax.control import PID, FeedforwardFeedback
from piezojax.core.axes import PerAxis
from piezojax.core.feedback import Feedback, LoopInput
from piezojax.dynamics import ARMA, StateSpace, channels_of
from piezojax.hardware import Saturation, Sensor
from piezojax.hysteresis import PrandtlIshlinskii

LANES, SAMPLES = 64, 2000
FEW_LANES = 8  # of long runs
TAPS = 64


class Problem(NamedTuple):
    """A loop as a function of its gains, the gains, and its inputs [samples, lanes]."""

    loop_of: Callable
    gains: jax.Array
    inputs: LoopInput


def inputs_of(lanes, samples):
    """Return sines and noise in um, different in every lane."""
    inputs = signals(*DOB_PID_SMC.problem(lanes, samples)[1:])
    return jax.tree.map(lambda x: jnp.array(x.T), inputs)


def by_size(lanes, samples):
    loop_of = LOOPS[DOB_PID_SMC.name]()
    return Problem(loop_of, jnp.array(NOMINAL_GAINS), inputs_of(lanes, samples))


def by_plays(count):
    """Return the loop of a PID and a stage with ``count`` plays of equal weight."""
    thresholds = 50.0 * np.arange(1, count + 1) / (count + 1)
    weights = np.full(count, 0.3 * p753.GAIN / count)
    hysteresis = PrandtlIshlinskii((0.8 * p753.GAIN,), thresholds, weights)
    plant = hysteresis >> p753.plant().parts[1]

    def loop_of(gains):
        return Feedback(pid_of(gains), plant, p753.actuator(), Sensor(1.0))

    return Problem(loop_of, jnp.array((0.5, 3000.0, 1e-5)), inputs_of(LANES, SAMPLES))


def pid_of(gains):
    """Return the PID of the P-753 with P, I and D in ``gains``."""
    where = lambda c: (c.proportional, c.integral, c.derivative)  # noqa: E731
    return eqx.tree_at(where, p753.pid(), tuple(gains))


def by_taps(count):
    """Return the loop whose first ``count`` taps are tuned."""
    taps = np.full(TAPS, 1.0 / p753.GAIN / TAPS)
    controller = FeedforwardFeedback(ARMA((), taps), p753.pid())

    def loop_of(gains):
        tuned = eqx.tree_at(
            lambda c: c.inverse.moving[:count], controller, tuple(gains)
        )
        return p753.loop(tuned, noise_rms=1.0)

    return Problem(loop_of, jnp.array(taps[:count]), inputs_of(LANES, SAMPLES))


def by_axes(count):
    """Return the loop of a PID on each axis, whose inputs move all ``count`` axes.

    The channels of the P-558 follow each other; beyond three axes the coupling between
    each three is a hundredth of that within them.
    """
    models = p558.channels("7")
    axes = range(count)
    coupling = [[1.0 if i // 3 == j // 3 else 0.01 for j in axes] for i in axes]
    channels = []
    for i in axes:
        model = models[i % 3]
        rows = [coupling[i][j] * model.C[j % 3] for j in axes]
        D = np.zeros((count, 1))
        channels.append(StateSpace(model.A, model.B, np.array(rows), D, p558.DT))
    plant = channels_of(channels)
    limits = PerAxis((Saturation(-1e4, 1e4),) * count)
    sensor = PerAxis((Sensor(0.1),) * count)

    def loop_of(gains):
        controller = PerAxis(tuple(PID(*each, dt=p558.DT) for each in gains))
        return Feedback(controller, plant, limits, sensor)

    printed = np.array(p558_control.PID_GAINS).T
    gains = jnp.array(printed[np.arange(count) % 3])
    inputs = jax.tree.map(lambda x: (x,) * count, inputs_of(LANES, SAMPLES))
    return Problem(loop_of, gains, inputs)
