"""A sweep from its study to its data set, on this machine or on a cluster."""

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
from .dataset import DamagedError, Merger, merged
from .local import local_chunks, workers
from .simulator import Simulator
from .store import RESULT, Store, identity_of

if TYPE_CHECKING:
    from distributed import Client
    from xarray import Dataset

DEFAULT = "sweep_p753"
"""Name of the study that is swept when none is given."""


ATTEMPTS = 3
"""How often damaged chunks are done again."""


@dataclass
class Swept:
    """What a run of a sweep has done.

    ``chunks`` of this run's share of ``points``; ``simulated`` of them now, in
    ``core_s`` seconds of cores or devices and ``wall_s`` of time. ``finished`` if the
    data set is there, at ``path``.
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
    ``out`` is the folder that holds what is done; a sweep that was interrupted goes on
    in it, and ``sweep.nc`` is there at the end. Without it nothing is kept but what is
    returned. ``shard`` (i, n) does the i-th of n parts: None is returned until all are
    there, which then are merged. ``samples`` draws so many points (Sobol) of the
    study's own box if it has no ``[sweep]``. ``client`` is a Dask client whose workers
    simulate instead of this process.

    Raises ValueError for a study that cannot be swept, and for a folder that holds
    something else.
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
        swept = run_sweep(case, Path(out), **options)
        if not swept.finished:
            return None
        return xr.open_dataset(swept.path, engine="h5netcdf", decode_times=False)
    with tempfile.TemporaryDirectory(prefix="piezojax-sweep-") as folder:
        swept = run_sweep(case, Path(folder), **options)
        with xr.open_dataset(
            swept.path, engine="h5netcdf", decode_times=False
        ) as dataset:
            return dataset.load()


def read_swept(
    study: str | Path | None = None,
    *,
    seed: int | None = None,
    samples: int | None = None,
) -> Case:
    """Read and build a study that is to be swept.

    Raises ValueError as ``study.read``, and for ``samples`` where ``[sweep]`` is a
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
                "--samples: the study sweeps a grid, whose points its counts say; set "
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
) -> Swept:
    """Do what is still to do of a share of the sweep, and merge if that was the last.

    Raises ValueError as ``sweep``. ``KeyboardInterrupt`` leaves whole files, from which
    the next call goes on.
    """
    progress = progress or Silent()
    progress.stage("preparing")
    simulator = Simulator(case)
    store = Store(folder, identity_of(simulator))
    plan = simulator.plan
    share = plan.share(shard)
    store.open()
    swept = Swept(simulator, folder / RESULT, len(share))
    if merged(folder, store.fingerprint):
        swept.finished = True
        return swept
    begin = time.perf_counter()
    todo = store.missing(share)
    for _ in range(ATTEMPTS):
        _simulate(swept, store, todo, client, progress)
        swept.wall_s = time.perf_counter() - begin
        if not store.there(range(plan.chunks)):
            return swept
        progress.stage("merging")
        try:
            Merger(simulator, store).merge()
        except DamagedError as error:
            todo = error.chunks
            continue
        swept.finished = True
        return swept
    raise ValueError(f"{folder}: chunks {todo[:5]} keep being damaged; see to the disk")


def _simulate(
    swept: Swept,
    store: Store,
    todo: list[int],
    client: "Client | None",
    progress: Progress,
) -> None:
    if not todo:
        return
    simulator, devices = swept.simulator, workers()
    if client is None:
        progress.stage("compiling")
        for device in dict.fromkeys(devices):
            simulator.compile(device)
    kept = swept.chunks - len(todo)
    progress.stage(
        f"simulating {len(todo)} chunks" + (f" ({kept} are kept)" if kept > 0 else ""),
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
            swept.simulated += 1
            swept.lane_steps += (stop - start) * simulator.lane_steps
            swept.core_s += seconds
            now = time.perf_counter()
            each = (now - begin) / number
            if number == 1:
                first = now  # until then workers of a cluster start and compile
            else:
                each = (now - first) / (number - 1)
            progress.advance(math.nan, remaining(each * (len(todo) - number)))


def remaining(seconds: float) -> str:
    """Return how long is left, in words."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"about {seconds / size:.1f} {unit} left"
    return f"about {seconds:.0f} s left"
