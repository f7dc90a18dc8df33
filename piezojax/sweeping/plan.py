"""Which points a sweep tries, cut into chunks: a pure function of the study."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from ..core.arrays import as_array
from ..core.parameter import Scale
from ..core.paths import get, replace
from ..core.rollout import BLOCK
from ..core.serial import from_data, to_data
from ..core.space import Range, space_of
from ..core.system import System
from ..study import Case, Study
from ..study.sweep_table import SweepTable, SweptParameter

CHUNK_LANE_STEPS = 5e7
"""Simulated samples of a chunk, plants and references included: a good part of a
second, so that an interrupt costs little and writing less."""

CHUNK_BYTES = 64e6
"""What a chunk may hold in memory, whatever is kept of its runs."""

MOST_CHUNKS = 4096
"""Beyond this many chunks they grow, as far as memory lets them."""

FEWEST_CHUNKS = 16
"""Small sweeps, too, keep several cores busy."""

TRAJECTORIES = ("displacement", "voltage")
"""Signals that are kept at every N-th sample if a study asks for them."""

UNITS = {
    "cutoff": "rad/s",
    "noise_rms": "um",
    "surface": "1/s",
    "time_constant": "s",
}
"""Units of parameters that mean the same wherever they occur, by their name."""


@dataclass(frozen=True)
class Axis:
    """A parameter that is varied; ``values`` are its points in a grid."""

    path: str
    unit: str
    scale: Scale
    lower: float
    upper: float
    values: np.ndarray | None = None


class Plan:
    """The points of a sweep.

    ``shape`` is that of the grid, or the number of samples. Points are counted through
    in C order; ``chunk`` of them belong together, in blocks of ``width``. Any process
    that makes the plan of the same study gets the same points.
    """

    def __init__(self, case: Case):
        study, table = case.study, swept(case.study)
        self.axes = tuple(_axes(study, table))
        self.method = table.method
        _check_paths(case, self.axes)
        if table.method == "grid":
            self.shape = tuple(len(axis.values) for axis in self.axes)  # type: ignore[arg-type]
            self._sampled = None
        else:
            assert table.samples is not None
            self.shape = (table.samples,)
            self._sampled = _samples(table, self.axes, study.seed)
        self.points = math.prod(self.shape)
        most = max(1, int(CHUNK_BYTES / bytes_of_point(study)))
        self.width = min(BLOCK, self.points, most)
        self.chunk = self._chunk(study, table, most)
        self.chunks = -(-self.points // self.chunk)

    def _chunk(self, study: Study, table: SweepTable, most: int) -> int:
        if table.chunk is not None:
            wanted = table.chunk
        else:
            lane_steps = runs_of_point(study) * samples_of(study)
            wanted = max(CHUNK_LANE_STEPS / lane_steps, self.points / MOST_CHUNKS)
            wanted = min(wanted, most, self.points / FEWEST_CHUNKS)
        return max(1, math.ceil(wanted / self.width)) * self.width

    def span(self, chunk: int) -> tuple[int, int]:
        """Return the first point of a chunk and the one after its last."""
        start = chunk * self.chunk
        return start, min(start + self.chunk, self.points)

    def values(self, start: int, stop: int) -> np.ndarray:
        """Return the parameters of points: an array [points, parameters]."""
        if self._sampled is not None:
            return self._sampled[start:stop]
        places = np.unravel_index(np.arange(start, stop), self.shape)
        columns = [
            np.asarray(axis.values)[place]
            for axis, place in zip(self.axes, places, strict=True)
        ]
        return np.stack(columns, axis=1)

    def share(self, shard: tuple[int, int]) -> range:
        """Return the chunks of shard i of n, counted from 1.

        Raises ValueError for a shard that is none.
        """
        number, count = shard
        if not 1 <= number <= count:
            raise ValueError(
                f"shard {number}/{count}: shards are counted from 1/{max(count, 1)} to "
                f"{max(count, 1)}/{max(count, 1)}"
            )
        return range(number - 1, self.chunks, count)


def swept(study: Study) -> SweepTable:
    """Return the table ``[sweep]``; raise ValueError, saying what to add, without."""
    if study.sweep is None:
        raise ValueError(
            'the study has no table [sweep]: add method = "grid" and a parameter, as '
            'in [sweep.parameters] "controller.cutoff" = { lower = 100.0, upper = 2e4, '
            'count = 20, scale = "log" }, or give --samples N to draw points of '
            "the box that [parameters] describes"
        )
    return study.sweep


def references_of(study: Study) -> tuple[str, ...]:
    """Return the references that a sweep follows."""
    table = study.references
    return swept(study).references or (*table.tune, *table.unseen)


def plants_of(case: Case) -> dict[str, System]:
    """Return the plants of a sweep by name, the study's own if it names none."""
    own = str(case.study.plant.get("catalog", "own"))
    return dict(case.plants) or {own: case.loop.plant}


def runs_of_point(study: Study) -> int:
    """Return how many simulations a point takes."""
    plants = len(swept(study).plants) or 1
    return plants * len(references_of(study)) * study.holdout_draws


def samples_of(study: Study) -> int:
    """Return the samples of a simulation."""
    return round(study.references.duration * study.rate)


def bytes_of_point(study: Study) -> int:
    """Return what is kept of a point."""
    table = swept(study)
    kept = len(table.metrics)
    if table.every:
        kept += len(TRAJECTORIES) * -(-samples_of(study) // table.every)
    return 8 * runs_of_point(study) * kept * study.axis_count


def _axes(study: Study, table: SweepTable) -> list[Axis]:
    if table.parameters:
        return [_axis(path, swept) for path, swept in table.parameters.items()]
    return [
        Axis(path, _unit(path), bound.scale, bound.lower, bound.upper)
        for path, bound in study.parameters.items()
    ]


def _unit(path: str, given: str | None = None) -> str:
    return given if given is not None else UNITS.get(path.split(".")[-1], "")


def _axis(path: str, table: SweptParameter) -> Axis:
    unit = _unit(path, table.unit)
    if table.values is not None:
        values = np.array(table.values, dtype=float)
        return Axis(path, unit, table.scale, values[0], values[-1], values)
    assert table.lower is not None
    assert table.upper is not None
    bounds = Range(table.lower, table.upper, table.scale)
    try:
        space = space_of({path: bounds})
    except ValueError as error:
        raise ValueError(f"sweep.parameters.{error}") from None
    if table.count is None:
        return Axis(path, unit, table.scale, table.lower, table.upper)
    unit_points = as_array(np.linspace(0.0, 1.0, table.count)[:, None])
    values = np.array(jax.vmap(space.from_unit)(unit_points))[:, 0]
    values[[0, -1]] = table.lower, table.upper
    return Axis(path, unit, table.scale, table.lower, table.upper, values)


def _samples(table: SweepTable, axes: Sequence[Axis], seed: int) -> np.ndarray:
    # Half a second to import, which most commands can do without.
    from scipy.stats import qmc

    assert table.samples is not None
    # A stream of its own: noise and ensembles have the others.
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4,)))
    if table.method == "sobol":
        # Drawn to a power of two: the first points of a balanced set.
        power = max(0, math.ceil(math.log2(table.samples)))
        engine = qmc.Sobol(len(axes), rng=generator)
        unit = engine.random_base2(power)[: table.samples]
    else:
        unit = qmc.LatinHypercube(len(axes), rng=generator).random(table.samples)
    space = space_of({a.path: Range(a.lower, a.upper, a.scale) for a in axes})
    return np.array(jax.vmap(space.from_unit)(as_array(unit)))


def _check_paths(case: Case, axes: Sequence[Axis]) -> None:
    """Raise ValueError for a path or a bound that one of the loops does not take."""
    for name, plant in plants_of(case).items():
        for axis in axes:
            part = axis.path.split(".")[0]
            parts = {
                "controller": case.loop.controller,
                "plant": plant,
                "actuator": case.loop.actuator,
                "sensor": case.loop.sensor,
            }
            inner = axis.path.removeprefix(f"{part}.")
            where = f"sweep.parameters.{axis.path}"
            if part == "plant" and case.plants:
                where = f"{where}, plant {name}"
            try:
                get(parts[part], inner)
                for value in (axis.lower, axis.upper):
                    # Built anew, so that the constructor's own checks speak.
                    changed = replace(parts[part], {inner: value})
                    from_data(to_data(changed))
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from None
