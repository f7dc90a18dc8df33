"""Simulated stage, references and errors of chapters 7 and 8."""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..catalog import p558, p558_control, p558_stage
from ..core.arrays import State
from ..core.axes import PerAxisMetric
from ..core.feedback import LoopSample, loop_inputs
from ..core.metrics import Tracking
from ..core.rollout import Metric, simulate
from ..core.system import System
from ..signals import waveforms as signals
from .cell import Cell, printed

AXES = p558.OUTPUTS

FREQUENCIES = (1, 5, 10)
"""Frequencies of the sines in the tables, Hz."""

LENGTH_S = 4.0
"""Duration of a run, s, which is not printed; the second half counts."""

SEED = 7
"""Seed of the sensor noise."""

EXPERIMENTS = ("experiment_1", "experiment_2")
"""The combined experiments of sections 7.5.4.3 and 8.5.4.2."""


class Column(NamedTuple):
    """A controller, and the additional delay of its stage beyond (7.53), samples."""

    make: Callable[[], System]
    delay: int


def references() -> dict[str, np.ndarray]:
    """Return the references of the axes [samples, 3] by the name of the run.

    The tables drive one axis at a time with a sine of 10 um or urad. The first combined
    experiment has a sine of 2 Hz and 10 um in Z, and one of 5 Hz and 50 urad in Rx. The
    second has a PWSW of 2 Hz and 10 um in Z, and an SW of 10 Hz in Ry, whose largest
    distance from its mean is 50 urad.
    """
    time = signals.time_grid(LENGTH_S, 1.0 / p558.DT)
    at_rest = np.zeros((time.size, 3))
    runs: dict[str, np.ndarray] = {}
    for axis, name in enumerate(AXES):
        for hertz in FREQUENCIES:
            wave = at_rest.copy()
            wave[:, axis] = 10.0 * _sine(time, float(hertz))
            runs[f"drive_{name}_{hertz}Hz"] = wave
    first, second = at_rest.copy(), at_rest.copy()
    first[:, 0], first[:, 1] = 10.0 * _sine(time, 2.0), 50.0 * _sine(time, 5.0)
    second[:, 0] = signals.piecewise_sine(time, 2.0, 10.0)
    wave = np.asarray(signals.superposed_sine(time, 10.0, 5.0)) - 5.0
    second[:, 2] = 50.0 * wave / np.abs(wave).max()
    runs.update(zip(EXPERIMENTS, (first, second), strict=True))
    return runs


def _sine(time: Array, hertz: float) -> np.ndarray:
    return np.sin(2.0 * np.pi * hertz * np.asarray(time))


def noise_draws(runs: int, samples: int) -> Float[Array, "runs samples axes"]:
    """Return the sensor noise with unit variance; every call returns the same."""
    noise = np.random.default_rng(SEED).standard_normal((runs, samples, 3))
    return jnp.asarray(noise)


class Measured(Metric):
    """A ``metric`` of the measured instead of the true displacement."""

    metric: Metric

    def init(self) -> State:
        return self.metric.init()

    def update(self, total: State, index: Array, output: LoopSample) -> State:
        measured = output._replace(displacement=output.measured)
        return self.metric.update(total, index, measured)

    def result(self, total: State) -> Any:
        return self.metric.result(total)


def _rest_at_zero(loop: System) -> State:
    """Return the state of ``loop`` at rest at zero; all of its leaves are zero.

    ``loop.init`` would give the same, but takes as long to compile as the run.
    """
    shapes = eqx.filter_eval_shape(loop.init, jnp.zeros(3))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


@eqx.filter_jit
def _rms_errors(loop: System, targets: Array, noise: Array) -> Float[Array, "runs 3"]:
    rest = _rest_at_zero(loop)
    metric = Measured(PerAxisMetric(Tracking(start=targets.shape[1] // 2), 3))

    def simulate_run(target, noise):
        inputs = loop_inputs(target, noise)
        return simulate(loop, inputs, rest, metric=metric, segment=target.shape[0])[
            1
        ].rms_error

    return jax.vmap(simulate_run)(targets, noise)


@cache
def rms_errors(column: Column) -> Mapping[str, Mapping[str, float]]:
    """Return the RMS errors of all runs by name and axis, um and urad.

    An error is the measured output minus the reference (section 7.5.4.3), over the
    second half of a run from rest at zero.
    """
    runs = references()
    targets = jnp.asarray(np.stack(list(runs.values())))
    loop = p558_control.loop(column.make(), plant=p558_stage.plant(delay=column.delay))
    rms = np.asarray(_rms_errors(loop, targets, noise_draws(*targets.shape[:2])))
    return {
        name: dict(zip(AXES, map(float, errors), strict=True))
        for name, errors in zip(runs, rms, strict=True)
    }


def table_cells(
    chapter: str, table: str, columns: Mapping[str, Column], *, transposed: bool = False
) -> list[Cell]:
    """Return the cells of a table of single sines, 27 for each of ``columns``.

    Rows are driven axes, columns are measured axes; ``transposed`` exchanges them for
    a table that is printed transposed off its diagonal. The groups are the cells of the
    driven axes and the couplings, for each controller.
    """
    simulated = []
    for (row, column), cell in printed(chapter, table).items():
        name, measured = column.split(":")
        _, driven, hertz = row.split("_")
        group = "driven" if measured == driven else "coupling"
        if transposed:
            driven, measured = measured, driven
        errors = rms_errors(columns[name])[f"drive_{driven}_{hertz}"]
        simulated.append(cell.simulated(errors[measured], f"{name} {group}"))
    return simulated


def experiment_cells(
    chapter: str, table: str, columns: Mapping[str, Column], run: str
) -> list[Cell]:
    """Return the printed cells of the combined experiment ``run``, simulated."""
    return [
        cell.simulated(rms_errors(columns[column])[run][axis])
        for (axis, column), cell in printed(chapter, table).items()
    ]
