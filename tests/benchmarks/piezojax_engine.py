"""piezojax as an engine of the throughput benchmark (see engines.py)."""

import time
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from engines import DOB_PID_SMC, Engine
from loop_three_dof import THREE_DOF_PID_SMC

from piezojax.catalog import p558_control, p753
from piezojax.core.axes import PerAxisMetric
from piezojax.core.feedback import LoopInput
from piezojax.core.metrics import Chosen, Tracking
from piezojax.engines import metered, reverse_mode

BLOCK = 64  # lanes simulated at a time


def loop(gains):
    """Return the loop with these gains [8]; its noise is in um."""
    controller = eqx.tree_at(
        lambda c: (
            c.feedback.law.proportional,
            c.feedback.law.integral,
            c.feedback.law.derivative,
            c.feedback.surface,
            c.feedback.control_weight,
            c.feedback.filter.alpha,
            c.feedback.filter.beta,
            c.cutoff,
        ),
        p753.disturbance_observer(),
        tuple(gains),
    )
    return p753.loop(controller, noise_rms=1.0)


def three_dof(gains, base, stage):
    """Return the loop of loop_three_dof.py with P, I, D of each axis in gains [9]."""
    diagonals = [gains[:3], gains[3:6], gains[6:]]
    controller = eqx.tree_at(
        lambda c: [
            matrix[axis]
            for matrix in (
                c.controller.law.proportional,
                c.controller.law.integral,
                c.controller.law.derivative,
            )
            for axis in range(3)
        ],
        base,
        [gain for values in diagonals for gain in values],
    )
    return p558_control.loop(controller, noise_rms=(1.0, 1.0, 1.0), plant=stage)


def three_dof_loops():
    """Return the function from gains [9] to a loop, its parts made outside jit."""
    base, stage = p558_control.multi_axis("dynamic"), p558_control.stage()
    return lambda gains: three_dof(gains, base, stage)


LOOPS = {DOB_PID_SMC.name: lambda: loop, THREE_DOF_PID_SMC.name: three_dof_loops}
"""Functions that make loop_of(gains), by the name of the loop."""


def rms(loop_of, gains, inputs, holding=None):
    """Return the RMS errors of one lane over the second half of the run, by axis.

    ``holding`` is the input that holds the plant at rest, if it is known.
    """
    system = loop_of(gains)
    samples = jax.tree.leaves(inputs)[0].shape[0]
    metric = Tracking(start=samples // 2)
    start = 0.0
    if isinstance(inputs.noise, tuple):
        metric = PerAxisMetric(metric, len(inputs.noise))
        start = (0.0,) * len(inputs.noise)
    metric = Chosen(metric, ("rms_error",))
    return metered(system, inputs, system.init(start, holding), metric)[0]["rms_error"]


def block_of_rms(loop_of, gains, inputs):
    """Return the RMS errors of a block: gains [width, n], inputs [steps, width]."""
    return jax.vmap(lambda g, u: rms(loop_of, g, u), in_axes=(0, 1))(gains, inputs)


def mean_square(loop_of, gains, inputs, holding=None):
    """Return the loss for gains [n] of all lanes and inputs [steps, lanes]."""
    lanes = jax.vmap(lambda u: rms(loop_of, gains, u, holding), in_axes=1)(inputs)
    return jnp.mean(lanes**2)


def value_and_gradient(loop_of, gains, inputs, holding=None):
    """Return the loss and its gradient [n], in reverse mode as in a search."""
    with reverse_mode(True):
        loss = lambda g: mean_square(loop_of, g, inputs, holding)  # noqa: E731
        return jax.value_and_grad(loss)(gains)


def signals(reference, noise):
    """Return the LoopInput of [lanes, steps+1] and [lanes, steps], by axis if any."""
    if noise.ndim == 2:
        return LoopInput(reference[:, 1:], noise)
    axes = range(noise.shape[2])
    return LoopInput(
        tuple(reference[:, 1:, axis] for axis in axes),
        tuple(noise[..., axis] for axis in axes),
    )


class PiezojaxEngine(Engine):
    """Engine in piezojax: a loop of the benchmark as a user would run it.

    `what` is "forward" or "gradient".

    forward: gains [B, 8] (order of engines.GAIN_NAMES), reference [B, steps+1] and
    noise [B, steps] in um, one row a lane; `run` returns the RMS error [B] in um. One
    program runs a block of lanes, and is called for block after block.

    gradient: one gains vector [8], shared by all lanes; the loss is the mean over
    lanes of the mean over k = steps//2 ... steps-1 of (y(k) - r(k))^2, in um^2;
    `run` returns (loss, gradient [8]), in reverse mode.
    """

    name = "piezojax"

    def __init__(self, what="forward", loop=DOB_PID_SMC):
        self.what = what
        self._loop_of = LOOPS[loop.name]()

    def prepare(self, gains, reference, noise):
        """Build the loop, put the data on the device and compile for their shapes.

        This is everything except simulation: conversion, layout, tracing, compiling
        (ahead of time, so that nothing is left for the first run). Sets
        `self.compile_s` to the seconds of tracing and compiling. Called anew for other
        shapes and for other data.
        """
        inputs = signals(reference, noise)
        if self.what == "forward":
            self._lanes = len(gains)
            width = min(BLOCK, self._lanes)
            self._calls = [
                self._block(gains, inputs, np.arange(start, start + width))
                for start in range(0, self._lanes, width)
            ]
            function = partial(block_of_rms, self._loop_of)
        else:
            first = jax.tree.map(lambda x: jnp.array(x.T), inputs)
            self._calls = [(jnp.array(gains), first)]
            function = partial(value_and_gradient, self._loop_of)
        begin = time.perf_counter()
        self._compiled = jax.jit(function).lower(*self._calls[0]).compile()
        self.compile_s = time.perf_counter() - begin

    def _block(self, gains, inputs, lanes):
        """Return these lanes; the last one fills the last block."""
        lanes = np.minimum(lanes, self._lanes - 1)
        signals = jax.tree.map(lambda x: jnp.array(x[lanes].T), inputs)
        return jnp.array(gains[lanes]), signals

    def run(self):
        """Simulate the prepared data once and wait for the result.

        Returns NumPy arrays (so the device has finished): rms [B] for "forward",
        agreeing with engines.c_engine to 1e-9 um; (loss, gradient [8]) for
        "gradient", agreeing with central differences of engines.c_engine. Keeps no
        result of an earlier run: each call simulates again.
        """
        results = [self._compiled(*arguments) for arguments in self._calls]
        if self.what == "forward":
            return np.concatenate([np.asarray(r) for r in results])[: self._lanes]
        return jax.tree.map(np.asarray, results[0])
