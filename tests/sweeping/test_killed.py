"""Processes that are killed during a sweep."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr

import piezojax as pj
from piezojax.sweeping.cluster import dask_client

# Some 60 chunks of a few milliseconds each.
MANY = {"method": "latin_hypercube", "samples": 4000, "chunk": 64}


def bits(dataset):
    return {name: dataset[name].values.tobytes() for name in ("rms_error", "saturated")}


def start(path, out):
    return subprocess.Popen(
        [sys.executable, "-m", "piezojax.sweep", path, "--out", out, "--quiet"]
    )


def chunks(out):
    return len(list((out / "chunks").glob("*.chunk")))


@pytest.mark.slow
def test_a_repeatedly_killed_sweep_loses_nothing(write, tmp_path):
    path, out = write(MANY), tmp_path / "killed"
    whole = pj.sweep(path, out=tmp_path / "whole")
    assert whole is not None
    # As after a first kill: a few chunks and no result.
    shutil.copytree(tmp_path / "whole", out)
    (out / "sweep.nc").unlink()
    draw = random.Random(1)
    before = draw.randint(1, 12)
    for chunk in sorted((out / "chunks").glob("*.chunk"))[before:]:
        chunk.unlink()
    process = start(path, out)
    # Kill it while it simulates and writes, after a few new chunks.
    wanted = before + draw.randint(1, 12)
    while chunks(out) < wanted and process.poll() is None:
        time.sleep(0.002)
    time.sleep(0.01 * draw.random())
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert wanted <= chunks(out) < 63
    assert not (out / "sweep.nc").exists()
    assert start(path, out).wait() == 0
    with xr.open_dataset(out / "sweep.nc", engine="h5netcdf") as found:
        assert found.identical(whole)
        assert bits(found) == bits(whole)


@pytest.mark.slow
def test_workers_of_a_cluster_give_the_same_result_when_killed(write, tmp_path):
    path = write(MANY | {"samples": 700})
    whole = pj.sweep(path)
    assert whole is not None
    with dask_client("2") as client:
        victims = list(client.run(os.getpid).values())
        assert len(set(victims)) == 2

        class Killing:
            """Progress that kills a worker after a few chunks."""

            done = 0

            def stage(self, text, steps=0):
                pass

            def advance(self, best, note=""):
                self.done += 1
                if self.done == 3:
                    os.kill(victims[0], signal.SIGKILL)

        killing = Killing()
        found = pj.sweep(path, client=client, progress=killing, out=tmp_path / "out")
    assert found is not None
    with found:
        assert bits(found) == bits(whole)
        assert np.isfinite(found.rms_error).any()
    assert killing.done == 11
