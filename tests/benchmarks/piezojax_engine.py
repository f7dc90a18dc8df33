"""piezojax as an engine of the throughput benchmark (see engines.py)."""

from engines import Engine


class PiezojaxEngine(Engine):
    """The loop "dob_pid_smc" as a user of piezojax would run it.

    `what` is "forward" or "gradient".

    forward: gains [B, 8] (order of engines.GAIN_NAMES), reference [B, steps+1] and
    noise [B, steps] in um, one row a lane; `run` returns the RMS error [B] in um.

    gradient: one gains vector [8], shared by all lanes; the loss is the mean over
    lanes of the mean over k = steps//2 ... steps-1 of (y(k) - r(k))^2, in um^2;
    `run` returns (loss, gradient [8]), by whichever mode piezojax itself would use.
    """

    name = "piezojax"

    def __init__(self, what="forward"):
        self.what = what

    def prepare(self, gains, reference, noise):
        """Build the loop, put the data on the device and compile for their shapes.

        Everything that is not simulation: conversion, layout, tracing, compiling
        (ahead of time, `jit(...).lower(...).compile()`, so that nothing is left for
        the first run). Sets `self.compile_s` to the seconds of tracing and
        compiling. Called anew for other shapes and for other data.
        """
        raise NotImplementedError("piezojax_engine.PiezojaxEngine is not filled in")

    def run(self):
        """Simulate the prepared data once and wait for the result.

        Returns NumPy arrays (so the device has finished): rms [B] for "forward",
        agreeing with engines.c_engine to 1e-9 um; (loss, gradient [8]) for
        "gradient", agreeing with central differences of engines.c_engine. Keeps no
        result of an earlier run: each call simulates again.
        """
        raise NotImplementedError("piezojax_engine.PiezojaxEngine is not filled in")
