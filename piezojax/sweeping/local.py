"""Simulation of chunks on this machine, with a thread for each device or CPU core."""

import os
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np

from ..core.runtime import simulate_side_by_side
from .simulator import Simulator

FinishedChunk = tuple[int, dict[str, np.ndarray], float]
"""Number of a chunk, its results, and its simulation time, s."""


def worker_devices() -> list[Any]:
    """Return the device of each thread.

    A CPU has a thread for each available core, or one if threads cannot run in
    parallel.
    """
    parallel = simulate_side_by_side()
    devices = jax.local_devices()
    if devices[0].platform != "cpu":
        return devices
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return [devices[i % len(devices)] for i in range(cores if parallel else 1)]


@contextmanager
def local_chunks(
    simulator: Simulator, chunks: Sequence[int], devices: Sequence[Any]
) -> Iterator[Iterator[FinishedChunk]]:
    """Yield an iterator over the finished ``chunks``, in any order.

    An early exit waits only for the running blocks.
    """
    stop, idle = threading.Event(), list(devices)

    def work(chunk: int) -> FinishedChunk | None:
        device = idle.pop()
        try:
            begin = time.perf_counter()
            arrays = simulator.chunk(chunk, device, stop.is_set)
            if arrays is None:
                return None
            return chunk, arrays, time.perf_counter() - begin
        finally:
            idle.append(device)

    with ThreadPoolExecutor(len(devices)) as pool:

        def iterate() -> Iterator[FinishedChunk]:
            todo = iter(chunks)
            running: set[Future] = set()
            while True:
                # A short queue bounds the memory of results that are not yet read.
                while len(running) < len(devices) + 1:
                    chunk = next(todo, None)
                    if chunk is None:
                        break
                    running.add(pool.submit(work, chunk))
                if not running:
                    return
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()

        try:
            yield iterate()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
