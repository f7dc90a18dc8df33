"""Sweeps of studies, on this machine or on a cluster."""

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.progress import Progress, Silent
from ..core.runtime import simulate_side_by_side
from ..study import Case, Study, build, load, shipped
from ..study.sweep_table import SweepTable
from ..study.tables import validated
from .cluster import cluster_chunks
from .dataset import DamagedError, Merger, is_merged
from .local import local_chunks, worker_devices
from .simulator import Simulator
from .store import RESULT, Store, identity_of

if TYPE_CHECKING:
    from distributed import Client
    from xarray import Dataset

DEFAULT = "sweep_p753"
"""Name of the default study."""

ATTEMPTS = 3
"""Largest number of attempts at simulating and merging, if chunks are damaged."""


@dataclass
class SweepResult:
    """Result of one run of a sweep.

    ``chunks`` is the number of chunks in the share of this run; it simulated
    ``simulated`` of them (``lane_steps`` samples) in ``core_s`` seconds of core or
    device time and ``wall_s`` seconds of wall time. ``finished`` is true if the data
    set ``path`` exists.
    """

    simulator: Simulator
    path: Path
    chunks: int
    simulated: int = 0
    lane_steps: int = 0
    core_s: float = 0.0
    wall_s: float = 0.0
    finished: bool = False


def sweep(
    study: Case | str | Path | None = None,
    *,
    out: str | Path | None = None,
    shard: tuple[int, int] = (1, 1),
    samples: int | None = None,
    client: "Client | None" = None,
    progress: Progress | None = None,
) -> "Dataset | None":
    """Simulate every point of a study's ``[sweep]`` and return the labelled data set.

    ``study`` is a Case, the path of a study file, or None for the shipped example.
    ``out`` is the folder of the results. An interrupted sweep continues in it, and at
    the end it contains ``sweep.nc``. Without ``out`` no files remain. ``shard`` (i, n)
    simulates the i-th of n parts; the run that completes the last part merges all of
    them, and the other runs return None. ``samples`` is the number of random points; a
    study without ``[sweep]`` draws them (Sobol) from the box of its tuned parameters.
    ``client`` is a Dask client, whose workers simulate instead of this process.

    Raises ValueError for a study that cannot be swept, and for a folder with other
    contents.
    """
    import xarray as xr

    simulate_side_by_side()
    case = study if isinstance(study, Case) else read_swept(study, samples=samples)
    if isinstance(study, Case) and samples is not None:
        raise ValueError("samples belong to a study file; a Case has its own [sweep]")
    if out is None and shard != (1, 1):
        raise ValueError("a shard needs a folder, out, that it shares with the others")
    options: dict[str, Any] = {"shard": shard, "client": client, "progress": progress}

    if out is not None:
        result = run_sweep(case, Path(out), **options)
        if not result.finished:
            return None
        return xr.open_dataset(result.path, engine="h5netcdf", decode_times=False)
    with tempfile.TemporaryDirectory(prefix="piezojax-sweep-") as folder:
        result = run_sweep(case, Path(folder), **options)
        with xr.open_dataset(
            result.path, engine="h5netcdf", decode_times=False
        ) as dataset:
            return dataset.load()


def read_swept(
    study: str | Path | None = None,
    *,
    seed: int | None = None,
    samples: int | None = None,
) -> Case:
    """Read the study of a sweep and build its Case.

    Raises ValueError as ``study.read`` does, and for ``samples`` if ``[sweep]`` is a
    grid.
    """
    path = Path(shipped(DEFAULT) if study is None else study)
    description = load(path)
    if samples is not None:
        description = _sampled(description, samples)
    return build(description, path, seed=seed)


def _sampled(study: Study, samples: int) -> Study:
    table = {"method": "sobol"}
    if study.sweep is not None:
        table = study.sweep.model_dump(exclude_unset=True)
        if study.sweep.method == "grid":
            raise ValueError(
                "--samples: the study sweeps a grid, whose counts fix its points; set "
                'sweep.method to "sobol" or "latin_hypercube"'
            )
    new = validated(SweepTable, table | {"samples": samples}, "sweep")
    return study.model_copy(update={"sweep": new})


def run_sweep(
    case: Case,
    folder: Path,
    *,
    shard: tuple[int, int] = (1, 1),
    client: "Client | None" = None,
    progress: Progress | None = None,
) -> SweepResult:
    """Simulate the missing chunks of a shard; merge if no shard has missing chunks.

    Raises ValueError as ``sweep`` does. After a ``KeyboardInterrupt`` the stored chunks
    are complete, and the next call continues from them.
    """
    progress = progress or Silent()
    progress.stage("preparing")
    simulator = Simulator(case)
    store = Store(folder, identity_of(simulator))
    plan = simulator.plan
    share = plan.share(shard)
    store.open()
    result = SweepResult(simulator, folder / RESULT, len(share))
    if is_merged(folder, store.fingerprint):
        result.finished = True
        return result
    begin = time.perf_counter()
    todo = store.missing(share)
    for _ in range(ATTEMPTS):
        _simulate(result, store, todo, client, progress)
        result.wall_s = time.perf_counter() - begin
        if not store.exist(range(plan.chunks)):
            return result
        progress.stage("merging")
        try:
            Merger(simulator, store).merge()
        except DamagedError as error:
            todo = error.chunks
            continue
        result.finished = True
        return result
    raise ValueError(
        f"{folder}: chunks {todo[:5]} are damaged after {ATTEMPTS} attempts; "
        "check the disk"
    )


def _simulate(
    result: SweepResult,
    store: Store,
    todo: list[int],
    client: "Client | None",
    progress: Progress,
) -> None:
    if not todo:
        return
    simulator, devices = result.simulator, worker_devices()
    if client is None:
        progress.stage("compiling")
        for device in dict.fromkeys(devices):
            simulator.compile(device)
    stored = result.chunks - len(todo)
    progress.stage(
        f"simulating {len(todo)} chunks"
        + (f" ({stored} are stored)" if stored > 0 else ""),
        len(todo),
    )
    if client is None:
        running = local_chunks(simulator, todo, devices)
    else:
        running = cluster_chunks(client, simulator, todo)
    begin = first = time.perf_counter()
    with running as chunks:
        for number, (chunk, arrays, seconds) in enumerate(chunks, start=1):
            store.write(chunk, arrays, seconds)
            start, stop = simulator.plan.span(chunk)
            result.simulated += 1
            result.lane_steps += (stop - start) * simulator.lane_steps
            result.core_s += seconds
            now = time.perf_counter()
            each = (now - begin) / number
            if number == 1:
                first = now  # before this, workers of a cluster start and compile
            else:
                each = (now - first) / (number - 1)
            progress.advance(math.nan, remaining(each * (len(todo) - number)))


def remaining(seconds: float) -> str:
    """Return the remaining time as text."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"about {seconds / size:.1f} {unit} left"
    return f"about {seconds:.0f} s left"
