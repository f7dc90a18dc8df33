"""Batched simulation of the cells of Tables 4-5, 5-3 and 5-5 with a given stage."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..catalog import p753
from ..core.arrays import State
from ..core.feedback import Feedback, LoopInput, loop_inputs
from ..core.paths import parameters, replace
from ..core.rollout import Metric, simulate
from ..core.system import System
from ..signals import waveforms as signals
from . import chapter4, chapter5
from .cell import Cell, window
from .suspect_numbers import CANDIDATES, REFERENCE, candidates_of

WARM_UP = 0.3
"""Time before the errors of a shortened run count, s.

The response to the jump of SW at its start decays in this time.
"""

SHORT = 1.0
"""Longest window of a shortened run, s; the windows of SW and PWSW are longer."""

SEED = 0
"""Seed of the sensor noise."""


class Lanes(eqx.Module):
    """Loops of one kind of controller, one lane for each cell.

    ``reference`` is in um. ``weight`` is one over the number of counted samples, and
    zero outside the window. ``noise`` has unit variance and is the same in all lanes.
    ``affected`` marks the lanes that contain a candidate, for each of
    ``suspect_numbers.CANDIDATES`` that appears in the cells. ``make_target`` maps
    controller and reference to the target of the displacement.
    """

    controller: System
    reference: Float[Array, "samples lanes"]
    weight: Float[Array, "samples lanes"]
    noise: Float[Array, " samples"]
    affected: dict[str, Bool[Array, " lanes"]]
    make_target: Callable[[System, Array], Array] = eqx.field(static=True)

    def target(self) -> Float[Array, "samples lanes"]:
        """Return the target of the displacement, um."""
        return jax.vmap(self.make_target, (0, 1), 1)(self.controller, self.reference)

    def scaled(self, factors: Mapping[str, Any]) -> "Lanes":
        """Return the lanes with their printed numbers multiplied by ``factors``."""
        reference, leaves = self.reference, parameters(self.controller)
        for name, lanes in self.affected.items():
            factor, suspect = jnp.where(lanes, factors[name], 1.0), CANDIDATES[name]
            if suspect.leaf == REFERENCE:
                reference = factor * reference
            for path in suspect.leaves(leaves):
                leaves[path] = factor * leaves[path]
        return eqx.tree_at(
            lambda lanes: (lanes.controller, lanes.reference),
            self,
            (replace(self.controller, leaves), reference),
        )


def _maker(cell: Cell) -> Callable[[], System]:
    if cell.table in chapter5.TABLES:
        make = chapter5.COLUMNS[cell.column]
        return lambda: make(chapter5.TABLES[cell.table])
    make = chapter4.COLUMNS[cell.table][cell.column].make
    return lambda: make(chapter4.RATES[cell.table])


def _reference_target(controller: System, reference: Array) -> Array:
    return reference


def _target_maker(cell: Cell) -> Callable[[System, Array], Array]:
    if cell.table in chapter5.TABLES:
        return _reference_target
    return chapter4.COLUMNS[cell.table][cell.column].target


def _counted_span(name: str, short: bool) -> tuple[int, int]:
    """Return the first counted sample and the sample after the last one."""
    repeat = window(name)
    first, length = (WARM_UP, min(repeat, SHORT)) if short else (repeat, repeat)
    start = round(first * p753.RATE)
    return start, start + round(length * p753.RATE)


def lanes_of(cells: Sequence[Cell], *, short: bool) -> list[Lanes]:
    """Return a Lanes for each column of ``cells``, in the order of ``by_column``.

    With ``short``, errors count after ``WARM_UP`` for at most ``SHORT`` seconds.
    Otherwise they count in the second of two windows, as in the tables.
    """
    longest = max(_counted_span(cell.row, short)[1] for cell in cells)
    return [_stacked(group, longest, short) for group in by_column(cells)]


def by_column(cells: Sequence[Cell]) -> list[list[Cell]]:
    """Return ``cells`` in groups with the same kind of controller."""
    columns = sorted({cell.column for cell in cells})
    return [[cell for cell in cells if cell.column == name] for name in columns]


def _stacked(cells: Sequence[Cell], longest: int, short: bool) -> Lanes:
    time = jnp.arange(longest) / p753.RATE
    controllers = [_maker(cell)() for cell in cells]
    references = [signals.signal(cell.row, time) for cell in cells]
    weight = np.zeros((longest, len(cells)))
    for lane, cell in enumerate(cells):
        start, stop = _counted_span(cell.row, short)
        weight[start:stop, lane] = 1.0 / (stop - start)
    return Lanes(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *controllers),
        jnp.stack(references, axis=1),
        jnp.asarray(weight),
        jnp.asarray(np.random.default_rng(SEED).standard_normal(longest)),
        {
            name: jnp.asarray([suspect.appears_in(cell) for cell in cells])
            for name, suspect in candidates_of(cells).items()
        },
        _target_maker(cells[0]),
    )


class _SquaredError(System):
    """A loop whose output is its weighted squared error, um^2."""

    loop: Feedback

    def init(self, input: Any = 0.0) -> State:
        return self.loop.init(input)

    def step(
        self, state: State, input: tuple[LoopInput, Array, Array]
    ) -> tuple[State, Array]:
        drive, target, weight = input
        state, sample = self.loop.step(state, drive)
        return state, weight * (sample.displacement - target) ** 2


class _Sum(Metric):
    def init(self) -> State:
        return jnp.zeros(())

    def update(self, total: State, index: Array, output: Array) -> State:
        return total + output

    def result(self, total: State) -> Array:
        return total


def mean_squares(stage: System, sensor: System, lanes: Lanes) -> Float[Array, " lanes"]:
    """Return the mean squared error (um^2) of the true displacement in each lane.

    ``stage`` maps V to um; ``sensor`` maps the displacement and a noise sample to the
    measured displacement. The loops start from rest at zero.
    """

    def simulate_lane(controller, reference, target, weight):
        loop = _SquaredError(Feedback(controller, stage, p753.actuator(), sensor))
        inputs = (loop_inputs(reference, lanes.noise), target, weight)
        return simulate(
            loop, inputs, loop.init(0.0), metric=_Sum(), segment=reference.shape[0]
        )[1]

    return jax.vmap(simulate_lane, in_axes=(0, 1, 1, 1))(
        lanes.controller, lanes.reference, lanes.target(), lanes.weight
    )
