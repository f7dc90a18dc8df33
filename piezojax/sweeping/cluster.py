"""Chunks on a cluster of Dask workers: the same program in other processes."""

import hashlib
import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import jax

from ..core.runtime import simulate_side_by_side
from ..study import Case
from .local import Done
from .simulator import Simulator

if TYPE_CHECKING:
    from distributed import Client

AHEAD = 2
"""Chunks handed to each worker: one at work, one waiting."""

RETRIES = 10
"""How often a chunk is tried anew after its worker has died under it."""


@contextmanager
def client_of(where: str) -> Iterator["Client"]:
    """Give a client of the scheduler at an address, or of so many new local workers.

    Raises ValueError if there is none, or the extra ``cluster`` is not installed.
    """
    try:
        from dask.config import set as dask_option
        from distributed import Client, LocalCluster
    except ImportError:
        raise ValueError("--dask needs Dask: pip install 'piezojax[cluster]'") from None
    if not where.isdigit():
        try:
            client = Client(where, timeout=10, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise ValueError(
                f"--dask {where}: no scheduler answers ({error})"
            ) from None
        with client:
            yield client
        return
    if int(where) < 1:
        raise ValueError(f"--dask {where}: it takes at least 1 worker")
    # Spawned: JAX has threads, and a fork of them may hang.
    with (
        dask_option({"distributed.worker.multiprocessing-method": "spawn"}),
        LocalCluster(
            n_workers=int(where),
            threads_per_worker=1,
            processes=True,
            silence_logs=logging.ERROR,
            dashboard_address=None,  # pyright: ignore[reportArgumentType]
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def cluster_chunks(
    client: "Client", simulator: Simulator, chunks: Sequence[int]
) -> Iterator[Iterator[Done]]:
    """Give an iterator over ``chunks`` as workers get them done, in any order.

    What a worker that dies had at work goes to another one.
    """
    from distributed import wait

    synchronous: Any = client  # its methods return coroutines for others

    case = _pickled(simulator.case)
    running: set[Any] = set()
    finished: Any = wait

    def iterate() -> Iterator[Done]:
        nonlocal running
        todo = iter(chunks)
        while True:
            room = AHEAD * max(1, sum(synchronous.nthreads().values()))
            while len(running) < room:
                chunk = next(todo, None)
                if chunk is None:
                    break
                running.add(
                    client.submit(
                        simulate_chunk, case, chunk, pure=False, retries=RETRIES
                    )
                )
            if not running:
                return
            with client.as_current():
                done, running = finished(running, return_when="FIRST_COMPLETED")
            for future in done:
                yield future.result()

    try:
        yield iterate()
    finally:
        client.cancel(list(running))


def _pickled(case: Case) -> bytes:
    import cloudpickle

    return cloudpickle.dumps(case)


def simulate_chunk(case: bytes, chunk: int) -> Done:
    """Simulate a chunk of a pickled case; for a worker."""
    key = hashlib.sha256(case).digest()
    if key not in _simulators:
        import cloudpickle

        simulate_side_by_side()
        _simulators.clear()
        _simulators[key] = Simulator(cloudpickle.loads(case))
        _simulators[key].compile(jax.devices()[0])
    begin = time.perf_counter()
    arrays = _simulators[key].chunk(chunk)
    assert arrays is not None
    return chunk, arrays, time.perf_counter() - begin


_simulators: dict[bytes, Simulator] = {}
"""That of the last sweep, for as long as the worker lives: compiled once."""
