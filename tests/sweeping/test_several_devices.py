"""Chunks of a sweep on several devices."""

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import sys
import jax
import numpy as np
from piezojax.sweeping import read_swept
from piezojax.sweeping.local import local_chunks
from piezojax.sweeping.simulator import Simulator

devices = jax.devices()
assert len(devices) == 2
simulator = Simulator(read_swept(sys.argv[1]))
used = {}
chunk = simulator.chunk
simulator.chunk = lambda index, device, stopped: used.setdefault(
    (index, device), chunk(index, device, stopped)
)
with local_chunks(simulator, range(3), devices) as chunks:
    found = {index: arrays for index, arrays, _ in chunks}
assert sorted(found) == [0, 1, 2]
assert {device for _, device in used} == set(devices)
for index, arrays in found.items():
    for device in devices:
        for name, values in chunk(index, device).items():
            np.testing.assert_array_equal(values, arrays[name])
"""


def test_any_device_simulates_the_same_chunk(write):
    table = {"method": "sobol", "samples": 150, "metrics": ["rms_error"], "chunk": 64}
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, write(table)],
        env=os.environ | {"XLA_FLAGS": flags},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
