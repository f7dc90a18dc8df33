"""Chunks on the devices of this machine: a thread for each, one for each CPU core."""

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

Done = tuple[int, dict[str, np.ndarray], float]
"""A chunk, what is kept of it, and the seconds it took."""


def workers() -> list[Any]:
    """Return a device for each thread: of a CPU one for each core the process has."""
    together = simulate_side_by_side()
    devices = jax.local_devices()
    if devices[0].platform != "cpu":
        return devices
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return [devices[i % len(devices)] for i in range(cores if together else 1)]


@contextmanager
def local_chunks(
    simulator: Simulator, chunks: Sequence[int], devices: Sequence[Any]
) -> Iterator[Iterator[Done]]:
    """Give an iterator over ``chunks`` as ``devices`` get them done, in any order.

    Left early, it ends after the blocks at work.
    """
    stop, free = threading.Event(), list(devices)

    def work(chunk: int) -> Done | None:
        device = free.pop()
        try:
            begin = time.perf_counter()
            arrays = simulator.chunk(chunk, device, stop.is_set)
            if arrays is None:
                return None
            return chunk, arrays, time.perf_counter() - begin
        finally:
            free.append(device)

    with ThreadPoolExecutor(len(devices)) as pool:

        def iterate() -> Iterator[Done]:
            todo = iter(chunks)
            running: set[Future] = set()
            while True:
                # Few wait: results that nobody has taken do not pile up.
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
