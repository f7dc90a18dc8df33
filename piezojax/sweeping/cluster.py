"""Simulation of chunks on a cluster of Dask workers."""

import hashlib
import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import jax

from ..core.runtime import simulate_side_by_side
from ..study import Case
from .local import FinishedChunk
from .simulator import Simulator

if TYPE_CHECKING:
    from distributed import Client

CHUNKS_PER_WORKER = 2
"""Chunks submitted to each worker: one running, one waiting."""

RETRIES = 10
"""Largest number of retries of a chunk whose worker died."""


@contextmanager
def dask_client(where: str) -> Iterator["Client"]:
    """Connect a Dask client; close it on exit.

    ``where`` is the address of a scheduler, or the number of local workers to start.
    Raises ValueError if no scheduler answers, if the number is 0, or if the extra
    ``cluster`` is not installed.
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
        raise ValueError(f"--dask {where}: at least 1 worker is needed")
    # Workers are spawned: JAX has threads, and a forked process may hang.
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
) -> Iterator[Iterator[FinishedChunk]]:
    """Yield an iterator over the finished ``chunks``, in any order.

    If a worker dies, its chunks go to another one. On exit, unfinished chunks are
    cancelled.
    """
    from distributed import wait

    # Annotations of Client include coroutines, which only asynchronous ones return.
    synchronous: Any = client

    case = _pickled(simulator.case)
    running: set[Any] = set()
    wait_for: Any = wait

    def iterate() -> Iterator[FinishedChunk]:
        nonlocal running
        todo = iter(chunks)
        while True:
            room = CHUNKS_PER_WORKER * max(1, sum(synchronous.nthreads().values()))
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
                done, running = wait_for(running, return_when="FIRST_COMPLETED")
            for future in done:
                yield future.result()

    try:
        yield iterate()
    finally:
        client.cancel(list(running))


def _pickled(case: Case) -> bytes:
    import cloudpickle

    return cloudpickle.dumps(case)


def simulate_chunk(case: bytes, chunk: int) -> FinishedChunk:
    """Simulate a chunk of a pickled case in a worker process."""
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
"""Compiled simulator of the latest sweep of this worker, by the hash of the case."""
