"""Tables 4-5 and 4-6, and the step responses of Figures 4.5 and 4.7."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..catalog import p753, p753_chapter4
from ..core.feedback import loop_inputs
from ..core.rollout import simulate
from ..core.system import System
from ..signals import waveforms as signals
from .cell import Cell, printed, window

RATES = {"4-5": 20_000, "4-6": 5_000}
"""Sampling rate of each table, Hz."""

STEP, STEP_DURATION = 5.0, 0.2
"""Height (um) and duration (s) of a step; the second half counts as settled."""

BAND = 0.02
"""Half width of the settling band, as a share of the step."""


def _reference_target(controller: System, reference: jax.Array) -> jax.Array:
    return reference


def _model_target(controller: Any, reference: jax.Array) -> jax.Array:
    """Return the output y_d (um) of the reference model, from rest at zero.

    The model is one sample ahead, so its output is delayed by a sample.
    """
    ahead = simulate(controller.reference_model, reference)[1]
    return jnp.concatenate([jnp.zeros(1), ahead[:-1]])


class Column(NamedTuple):
    """Column of a table: ``make`` returns its controller at a rate (Hz).

    ``target`` maps controller and reference (um) to the target of the displacement
    (um).
    """

    make: Callable[[int], System]
    target: Callable[[System, jax.Array], jax.Array]


COLUMNS = {
    "4-5": {
        "traditional": Column(p753_chapter4.traditional, _reference_target),
        "model_reference": Column(p753_chapter4.model_reference, _model_target),
        "continuous": Column(p753_chapter4.continuous, _reference_target),
    },
    "4-6": {
        "model_reference": Column(p753_chapter4.model_reference, _model_target),
        "continuous": Column(p753_chapter4.continuous, _reference_target),
    },
}
"""Columns of the tables by their names in ``data/ch4.csv``.

Table 4-6 lacks the traditional column, because its gains at 5 kHz are not printed.
"""


@eqx.filter_jit
def displacement(
    controller: System, reference: jax.Array, rate: int, stage: System | None = None
) -> jax.Array:
    """Return the displacement (um) of a loop without noise, from rest at zero.

    ``reference`` (um) is sampled at ``rate`` (Hz). ``stage`` is passed to
    ``p753_chapter4.loop``.
    """
    loop = p753_chapter4.loop(controller, rate, stage, noise_rms=0.0)
    return simulate(loop, loop_inputs(reference), loop.init(0.0))[1].displacement


def rms_errors(column: Column, names: Sequence[str], rate: int) -> dict[str, float]:
    """Return the RMS errors (um) of the controller of a column, by reference.

    The references ``names`` form one batch. Shorter ones are padded with their last
    value, and the padding does not count.
    """
    references = {
        name: signals.signal(name, signals.time_grid(2.0 * window(name), float(rate)))
        for name in names
    }
    longest = max(reference.size for reference in references.values())
    batch = jnp.stack(
        [
            jnp.pad(reference, (0, longest - reference.size), mode="edge")
            for reference in references.values()
        ]
    )
    errors = dict(zip(names, np.asarray(_errors(column, batch, rate)), strict=True))
    counted = {
        name: errors[name][reference.size // 2 : reference.size]
        for name, reference in references.items()
    }
    return {name: float(np.sqrt(np.mean(e**2))) for name, e in counted.items()}


@eqx.filter_jit
def _errors(column: Column, references: jax.Array, rate: int) -> jax.Array:
    controller = column.make(rate)

    def error(reference):
        output = displacement(controller, reference, rate)
        return output - column.target(controller, reference)

    return jax.vmap(error)(references)


class StepFigures(NamedTuple):
    """Overshoot (% of the step) and settling time (ms, to within 2 %)."""

    overshoot: float
    settling: float


def step_figures(output: Any, rate: float) -> StepFigures:
    """Return the figures of a response (um) to a ``STEP`` at sample 0.

    ``settling`` is infinite if the last sample is outside the band.
    """
    output = np.asarray(output)
    outside = np.flatnonzero(np.abs(output - STEP) > BAND * STEP)
    first = outside[-1] + 1 if outside.size else 0
    settling = 1e3 * first / rate if first < output.size else float("inf")
    return StepFigures(100.0 * (output.max() / STEP - 1.0), settling)


class Chatter(NamedTuple):
    """Peak-to-peak ``amplitude`` and ``centre`` of an oscillation, um."""

    amplitude: float
    centre: float


def chatter(output: Any) -> Chatter:
    """Return the chatter in the second half of ``output`` (um)."""
    settled = np.asarray(output)[np.size(output) // 2 :]
    low, high = settled.min(), settled.max()
    return Chatter(float(high - low), float(high + low) / 2.0)


def step_responses(rate: int = 20_000) -> dict[str, np.ndarray]:
    """Return the responses (um) to a ``STEP`` at ``rate`` (1 or 20 kHz) by column.

    The stage is that of chapter 5, because with the stage of the tables the bang-bang
    controller hits its limits at every sample. The model-reference controller of Table
    4-3 receives the unfiltered displacement, because with the printed filter neither
    stage settles at 20 kHz.
    """
    reference = jnp.full(round(STEP_DURATION * rate), STEP)
    controller = p753_chapter4.model_reference(
        rate, "4-3", p753_chapter4.unfiltered(rate)
    )
    stage = p753.plant()
    responses = {
        "reference_model": _model_target(controller, reference),
        "model_reference": displacement(controller, reference, rate, stage),
        "bang_bang": displacement(
            p753_chapter4.bang_bang(rate), reference, rate, stage
        ),
    }
    return {name: np.asarray(response) for name, response in responses.items()}


FIGURES = {
    "figure-4-5": ("bang_bang",),
    "figure-4-7": ("reference_model", "model_reference"),
}
"""Columns of each figure whose numbers are in the text of the thesis, at 20 kHz."""

TABLES = (*RATES, *FIGURES)


def cells(table: str) -> list[Cell]:
    """Return the cells of ``table`` (one of ``TABLES``), simulated.

    One reading of the thesis applies to all cells of Tables 4-5 and 4-6; nothing is
    tuned:

    - The gains and the rows of Table 4-1 are used as printed. The alpha-beta filter of
      20 kHz is also used at 5 kHz, where none is printed.
    - The stage is ``p753_chapter4.plant``, without sensor noise, from rest at zero.
    - A cell is the RMS error of the true displacement over the second of two windows
      (see ``window``). The error of the model-reference controller is relative to the
      output of its reference model, that of the others to the reference.

    The traditional column cannot agree: the only printed gains, Table 4-2, have a
    control weight that makes it too slow for all of its cells. The continuous column at
    5 kHz disagrees too: its printed integral gain looks ten times too small. For the
    figures, see ``step_responses``; the steps at 1 kHz are not reproduced.
    """
    return _figure(table) if table in FIGURES else _table(table)


def _table(table: str) -> list[Cell]:
    paper = printed("ch4", table)
    errors = {
        name: rms_errors(column, signals.THESIS, RATES[table])
        for name, column in COLUMNS[table].items()
    }
    return [
        paper[row, column].simulated(errors[column][row])
        for row in signals.THESIS
        for column in errors
    ]


def _figure(table: str) -> list[Cell]:
    measures = {"bang_bang": chatter}
    figures = {
        name: measures.get(name, lambda y: step_figures(y, p753.RATE))(output)
        for name, output in step_responses().items()
        if name in FIGURES[table]
    }
    return [
        cell.simulated(getattr(figures[column], row))
        for (row, column), cell in printed("ch4", table).items()
    ]
