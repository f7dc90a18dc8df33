"""Cells of Tables 4-5, 5-3 and 5-5 simulated at once, for a stage that is fitted."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..catalog import p753
from ..core.arrays import State
from ..core.paths import parameters, replace
from ..core.rollout import Metric, simulate
from ..core.system import Feedback, LoopInput, System, loop_inputs
from ..signals import waveforms as signals
from . import chapter4, chapter5
from .cell import Cell, window
from .doubts import DOUBTS, REFERENCE, candidates

WARM_UP = 0.3
"""Of a shortened run, before errors count, s: a jump of SW at its start rings off."""

SHORT = 1.0
"""Longest window of a shortened run, s: less than SW10 and SW30 take to repeat."""

SEED = 0
"""Of the sensor's noise."""


class Lanes(eqx.Module):
    """Loops of one kind of controller, a lane a cell; time first, in um.

    ``weight`` is one over the number of samples counted, or zero outside the window;
    ``noise``, of unit variance, is the same in all lanes. ``follow`` turns controller
    and reference into what the displacement is judged against; ``concerned`` marks,
    for each of ``doubts.DOUBTS`` that counts here, the lanes that hold it.
    """

    controller: System
    reference: Float[Array, "samples lanes"]
    weight: Float[Array, "samples lanes"]
    noise: Float[Array, " samples"]
    concerned: dict[str, Bool[Array, " lanes"]]
    follow: Callable[[System, Array], Array] = eqx.field(static=True)

    def target(self) -> Float[Array, "samples lanes"]:
        """Return what the displacement is to be, um."""
        return jax.vmap(self.follow, (0, 1), 1)(self.controller, self.reference)

    def with_doubts(self, factors: Mapping[str, Any]) -> "Lanes":
        """Return the lanes with their prints times ``factors``, by name."""
        reference, leaves = self.reference, parameters(self.controller)
        for name, lanes in self.concerned.items():
            factor, doubt = jnp.where(lanes, factors[name], 1.0), DOUBTS[name]
            if doubt.leaf == REFERENCE:
                reference = factor * reference
            for path in doubt.leaves(leaves):
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


def _reference(controller: System, reference: Array) -> Array:
    return reference


def _follow(cell: Cell) -> Callable[[System, Array], Array]:
    if cell.table in chapter5.TABLES:
        return _reference
    return chapter4.COLUMNS[cell.table][cell.column].target


def _spans(name: str, short: bool) -> tuple[int, int]:
    """Return first and last sample that count."""
    repeat = window(name)
    first, length = (WARM_UP, min(repeat, SHORT)) if short else (repeat, repeat)
    start = round(first * p753.RATE)
    return start, start + round(length * p753.RATE)


def lanes_of(cells: Sequence[Cell], *, short: bool) -> list[Lanes]:
    """Return ``cells``, a Lanes for each column, in the order of ``by_column``.

    ``short`` starts to count after ``WARM_UP`` and for at most ``SHORT`` seconds;
    otherwise the second of two windows counts, as in the tables.
    """
    longest = max(_spans(cell.row, short)[1] for cell in cells)
    return [_together(group, longest, short) for group in by_column(cells)]


def by_column(cells: Sequence[Cell]) -> list[list[Cell]]:
    """Return ``cells`` in groups of one controller's kind."""
    columns = sorted({cell.column for cell in cells})
    return [[cell for cell in cells if cell.column == name] for name in columns]


def _together(cells: Sequence[Cell], longest: int, short: bool) -> Lanes:
    time = jnp.arange(longest) / p753.RATE
    controllers = [_maker(cell)() for cell in cells]
    references = [signals.signal(cell.row, time) for cell in cells]
    weight = np.zeros((longest, len(cells)))
    for lane, cell in enumerate(cells):
        start, stop = _spans(cell.row, short)
        weight[start:stop, lane] = 1.0 / (stop - start)
    return Lanes(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *controllers),
        jnp.stack(references, axis=1),
        jnp.asarray(weight),
        jnp.asarray(np.random.default_rng(SEED).standard_normal(longest)),
        {
            name: jnp.asarray([doubt.concerns(cell) for cell in cells])
            for name, doubt in candidates(cells).items()
        },
        _follow(cells[0]),
    )


class _Judged(System):
    """A loop whose output is its squared error, weighted, in um^2."""

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
    """Return the mean squared error (um^2) of the true displacement, a lane a cell.

    ``stage`` turns V into um, ``sensor`` that and a draw into what is seen; from rest
    at zero.
    """

    def one(controller, reference, target, weight):
        loop = _Judged(Feedback(controller, stage, p753.actuator(), sensor))
        inputs = (loop_inputs(reference, lanes.noise), target, weight)
        return simulate(
            loop, inputs, loop.init(0.0), metric=_Sum(), segment=reference.shape[0]
        )[1]

    return jax.vmap(one, in_axes=(0, 1, 1, 1))(
        lanes.controller, lanes.reference, lanes.target(), lanes.weight
    )
