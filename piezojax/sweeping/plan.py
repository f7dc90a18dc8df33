"""Plan of a sweep: its points and their division into chunks."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import jax
import numpy as np

from ..core.arrays import as_array
from ..core.paths import declared, get
from ..core.paths import replace as replace_values
from ..core.rollout import BLOCK
from ..core.space import Range, space_of
from ..core.system import System
from ..study import Case, Study
from ..study.parameters import check_value
from ..study.sweep_table import SweepTable, SweptTable
from ..tuning.unexplained import STRETCHES, leaves_unexplained

ACCELERATED_BLOCK = 131072
"""Number of points of a block on an accelerator: enough to occupy it."""

CHUNK_LANE_STEPS = 5e7
"""Number of simulated samples of a chunk, over all runs of its points.

A chunk takes almost a second, so that an interrupt loses little work, and writing takes
less time than simulating.
"""

CHUNK_BYTES = 64e6
"""Largest size of the results of a chunk, bytes."""

MOST_CHUNKS = 4096
"""Target for the largest number of chunks; chunks grow to meet it, within
``CHUNK_BYTES``."""

FEWEST_CHUNKS = 16
"""Target for the smallest number of chunks; it keeps several cores busy."""

TRAJECTORIES = ("displacement", "voltage")
"""Signals that a sweep may record at every N-th sample."""


class Axis(NamedTuple):
    """A swept parameter: its path, its Range, and its points if they form a grid."""

    path: str
    range: Range
    values: np.ndarray | None = None


class Plan:
    """Points of a sweep, divided into chunks and blocks.

    The points depend only on the study, the chunks and blocks also on the device.
    ``shape`` is the shape of the grid, or the number of random samples. Points are
    numbered in C order. A chunk holds ``chunk`` points, in blocks of ``width``.
    """

    def __init__(self, case: Case):
        study, table = case.study, sweep_table(case.study)
        self.axes = tuple(_axes(case, table))
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
        most = max(1, int(CHUNK_BYTES / bytes_of_point(case)))
        block = BLOCK if jax.default_backend() == "cpu" else ACCELERATED_BLOCK
        if table.chunk is not None:
            block = min(block, max(BLOCK, table.chunk))
        self.width = min(block, self.points, most)
        self.chunk = self._chunk(case, table, most)
        self.chunks = -(-self.points // self.chunk)

    def _chunk(self, case: Case, table: SweepTable, most: int) -> int:
        if table.chunk is not None:
            wanted = table.chunk
        else:
            lane_steps = runs_of_point(case) * samples_of(case.study)
            wanted = max(CHUNK_LANE_STEPS / lane_steps, self.points / MOST_CHUNKS)
            wanted = min(wanted, most, self.points / FEWEST_CHUNKS)
        return max(1, math.ceil(wanted / self.width)) * self.width

    def span(self, chunk: int) -> tuple[int, int]:
        """Return the first point of a chunk and the point after its last."""
        start = chunk * self.chunk
        return start, min(start + self.chunk, self.points)

    def values(self, start: int, stop: int) -> np.ndarray:
        """Return the parameters of the points in a span, as [points, parameters]."""
        if self._sampled is not None:
            return self._sampled[start:stop]
        places = np.unravel_index(np.arange(start, stop), self.shape)
        columns = [
            np.asarray(axis.values)[place]
            for axis, place in zip(self.axes, places, strict=True)
        ]
        return np.stack(columns, axis=1)

    def share(self, shard: tuple[int, int]) -> range:
        """Return the chunks of shard (i, n), the i-th of n, counted from 1.

        Raises ValueError for a shard outside 1/n to n/n.
        """
        number, count = shard
        if not 1 <= number <= count:
            raise ValueError(
                f"shard {number}/{count}: shards are counted from 1/{max(count, 1)} to "
                f"{max(count, 1)}/{max(count, 1)}"
            )
        return range(number - 1, self.chunks, count)


def sweep_table(study: Study) -> SweepTable:
    """Return the table ``[sweep]``; raise ValueError if the study has none."""
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
    return sweep_table(study).references or (*table.tune, *table.unseen)


def plants_of(case: Case) -> dict[str, System]:
    """Return the plants of a sweep by name, by default the plant of the study."""
    own = str(case.study.plant.get("catalog", "own"))
    return dict(case.plants) or {own: case.loop.plant}


def runs_of_point(case: Case) -> int:
    """Return the number of simulations for each point."""
    study = case.study
    plants = len(sweep_table(study).plants) or 1
    stretches = STRETCHES if leaves_unexplained(case) else 1
    return plants * len(references_of(study)) * study.holdout_draws * stretches


def samples_of(study: Study) -> int:
    """Return the number of samples of each simulation."""
    return round(study.references.duration * study.rate)


def bytes_of_point(case: Case) -> int:
    """Return the size of the results of a point, bytes."""
    study, table = case.study, sweep_table(case.study)
    numbers = len(table.metrics)
    if table.every:
        numbers += len(TRAJECTORIES) * -(-samples_of(study) // table.every)
    return 8 * runs_of_point(case) * numbers * study.axis_count


def _axes(case: Case, table: SweepTable) -> list[Axis]:
    if table.parameters:
        return [
            _axis(case, path, parameter) for path, parameter in table.parameters.items()
        ]
    return [
        Axis(path, replace(bounds, unit=case.unit(path)))
        for path, bounds in case.space.ranges().items()
    ]


def _axis(case: Case, path: str, table: SweptTable) -> Axis:
    unit, where = case.unit(path), f"sweep.parameters.{path}"
    if table.values is not None:
        values = np.array(table.values, dtype=float)
        scale = table.scale or "linear"
        return Axis(path, Range(values[0], values[-1], scale, unit=unit), values)
    bounds = table.range(declared(case.loop, path), where)
    bounds = replace(bounds, unit=unit)
    bounds.check(where)
    if table.count is None:
        return Axis(path, bounds)
    space = space_of({path: bounds})
    unit_points = as_array(np.linspace(0.0, 1.0, table.count)[:, None])
    values = np.array(jax.vmap(space.from_unit)(unit_points))[:, 0]
    values[[0, -1]] = bounds.lower, bounds.upper
    return Axis(path, bounds, values)


def _samples(table: SweepTable, axes: Sequence[Axis], seed: int) -> np.ndarray:
    # Imported here, because the import takes half a second.
    from scipy.stats import qmc

    assert table.samples is not None
    # A separate random stream; noise and ensembles use the others.
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4,)))
    if table.method == "sobol":
        # The points are the first ones of a balanced set, whose size is a power of 2.
        power = max(0, math.ceil(math.log2(table.samples)))
        engine = qmc.Sobol(len(axes), rng=generator)
        unit = engine.random_base2(power)[: table.samples]
    else:
        unit = qmc.LatinHypercube(len(axes), rng=generator).random(table.samples)
    space = space_of({axis.path: axis.range for axis in axes})
    return np.array(jax.vmap(space.from_unit)(as_array(unit)))


def _check_paths(case: Case, axes: Sequence[Axis]) -> None:
    """Raise ValueError for an unknown path or bounds that one of the loops refuses."""
    for name, plant in plants_of(case).items():
        parts = {
            "controller": case.loop.controller,
            "plant": plant,
            "actuator": case.loop.actuator,
            "sensor": case.loop.sensor,
        }
        swept: dict[str, dict[str, Axis]] = {part: {} for part in parts}

        def where(axis: Axis, name: str = name) -> str:
            of_plant = axis.path.startswith("plant.") and case.plants
            return f"sweep.parameters.{axis.path}" + (
                f", plant {name}" if of_plant else ""
            )

        for axis in axes:
            part, _, inner = axis.path.partition(".")
            try:
                get(parts[part], inner)
            except ValueError as error:
                raise ValueError(f"{where(axis)}: {error}") from None
            for value in (axis.range.lower, axis.range.upper):
                check_value(parts[part], inner, value, where(axis))
            swept[part][inner] = axis
        for part, together in swept.items():
            if len(together) > 1:
                _check_together(parts[part], together, where)


def _check_together(
    part: System, axes: Mapping[str, Axis], where: Callable[[Axis], str]
) -> None:
    """Raise ValueError if ``part`` refuses two bounds at once, such as crossed limits.

    ``axes`` are the swept parameters by their path in ``part``. Each is at one end
    while all others are at either end, so that every pair of bounds is tried.
    """
    lower, upper = (
        {inner: getattr(axis.range, end) for inner, axis in axes.items()}
        for end in ("lower", "upper")
    )
    for own, others in product((lower, upper), repeat=2):
        for inner, axis in axes.items():
            check_value(replace_values(part, others), inner, own[inner], where(axis))
