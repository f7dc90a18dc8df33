"""piezojax as an engine of the throughput benchmark (see engines.py)."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from engines import Engine

import piezojax
from piezojax.catalog import p753
from piezojax.system import LoopInput

BLOCK = 64  # lanes simulated at a time


def loop(gains):
    """The loop with these gains [8]; its noise is given in um."""
    controller = eqx.tree_at(
        lambda c: (
            c.feedback.proportional,
            c.feedback.integral,
            c.feedback.derivative,
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


def rms(gains, inputs, **options):
    """RMS error (um) of one lane over the second half of the run."""
    system = loop(gains)
    metric = piezojax.Tracking(start=len(inputs.noise) // 2)
    _, figures = piezojax.simulate(
        system, inputs, system.init(0.0), metric=metric, **options
    )
    return figures.rms_error


def block_of_rms(gains, inputs):
    """RMS errors of a block: gains [width, 8], inputs [steps, width].

    One plain loop over signals that lie time first, as it reads them.
    """
    steps = len(inputs.noise)
    return jax.vmap(lambda g, u: rms(g, u, segment=steps), in_axes=(0, 1))(
        gains, inputs
    )


def mean_square(gains, inputs):
    """The loss: gains [8] shared by all lanes, inputs [lanes, steps]."""
    lanes = len(inputs.noise)
    # A copy for each lane: their gradients are then summed once, not in each step.
    each = jnp.broadcast_to(gains, (lanes, len(gains)))
    return jnp.mean(piezojax.in_blocks(rms, each, inputs) ** 2)


class PiezojaxEngine(Engine):
    """The loop "dob_pid_smc" as a user of piezojax would run it.

    `what` is "forward" or "gradient".

    forward: gains [B, 8] (order of engines.GAIN_NAMES), reference [B, steps+1] and
    noise [B, steps] in um, one row a lane; `run` returns the RMS error [B] in um. One
    program runs a block of lanes, and is called for block after block.

    gradient: one gains vector [8], shared by all lanes; the loss is the mean over
    lanes of the mean over k = steps//2 ... steps-1 of (y(k) - r(k))^2, in um^2;
    `run` returns (loss, gradient [8]), in reverse mode.
    """

    name = "piezojax"

    def __init__(self, what="forward"):
        self.what = what

    def prepare(self, gains, reference, noise):
        """Build the loop, put the data on the device and compile for their shapes.

        Everything that is not simulation: conversion, layout, tracing, compiling
        (ahead of time, so that nothing is left for the first run). Sets
        `self.compile_s` to the seconds of tracing and compiling. Called anew for other
        shapes and for other data.
        """
        inputs = LoopInput(reference[:, 1:], noise)
        if self.what == "forward":
            self._lanes = len(gains)
            width = min(BLOCK, self._lanes)
            self._calls = [
                self._block(gains, inputs, np.arange(start, start + width))
                for start in range(0, self._lanes, width)
            ]
            function = block_of_rms
        else:
            self._calls = [jax.tree.map(jnp.array, (gains, inputs))]
            function = jax.value_and_grad(mean_square)
        begin = time.perf_counter()
        self._compiled = jax.jit(function).lower(*self._calls[0]).compile()
        self.compile_s = time.perf_counter() - begin

    def _block(self, gains, inputs, lanes):
        """These lanes; the last one fills up the last block."""
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
