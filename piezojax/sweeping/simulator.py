"""Simulator of a sweep: one compiled program for every block of points."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.stability import OperatingPoint
from ..analysis.stability.closed_poles import closed_matrices, poles_of, stable
from ..analysis.stability.sampled_margins import peak_of
from ..analysis.stability.small_motion import sensitivities
from ..core.axes import PerAxisMetric, packed
from ..core.feedback import Feedback, loop_inputs
from ..core.limited import Watched
from ..core.metrics import Chosen, Tracking
from ..core.paths import replace
from ..core.rollout import Metric, in_blocks, simulate
from ..engines import WithMetric, metered
from ..signals.waveforms import time_grid
from ..study import Case, Stage
from ..study.sweep_table import SENSITIVITY
from ..tuning.data import make_data
from ..tuning.runs import RunNoise
from .plan import TRAJECTORIES, Plan, plants_of, references_of, sweep_table


class Simulator:
    """Simulator of the chunks of the plan of a case.

    References and noise are those of the hold-out of the study, the same for every
    point. The ``plan.width`` points of a block follow the same references. Therefore a
    sweep of a hundred thousand points needs no more input data than a single point.
    """

    def __init__(self, case: Case):
        self.case, self.plan = case, Plan(case)
        study, table = case.study, sweep_table(case.study)
        self.plants = plants_of(case)
        self.references = references_of(study)
        self.metrics, self.every = table.metrics, table.every
        if SENSITIVITY in self.metrics:
            if study.axes:
                raise ValueError(
                    f"sweep.metrics: {SENSITIVITY} needs a stage with one axis"
                )
            self._margin_duration = case.margin_duration
        data = make_data(case).holdout
        names = (*study.references.tune, *study.references.unseen)
        chosen = np.array([names.index(name) for name in self.references])
        # One row for each run: each reference repeats for every draw of noise.
        self.draws = data.noise.shape[1]
        self.reference = data.references[np.repeat(chosen, self.draws)]
        self.run_noise = jax.tree.map(
            lambda x: x[chosen].reshape(self.reference.shape), data.run_noise
        )
        self.start = study.settled
        self.samples = self.reference.shape[1]
        self._programs: dict[Any, Callable] = {}
        self._inputs: dict[Any, Any] = {}
        self._lock = threading.Lock()

    @property
    def lane_steps(self) -> int:
        """Number of simulated samples of a point, all plants and runs together."""
        return self.samples * self.reference.shape[0] * len(self.plants)

    def times(self) -> np.ndarray | None:
        """Return the times (s) of the recorded samples; None if none are recorded."""
        if self.every is None:
            return None
        study = self.case.study
        return np.asarray(time_grid(study.references.duration, study.rate))[
            :: self.every
        ]

    def _metric(self) -> Metric:
        names = tuple(name for name in self.metrics if name != SENSITIVITY)
        metric: Metric = Chosen(Tracking(start=self.start), names)
        if self.reference.ndim > 2:
            metric = PerAxisMetric(metric, self.reference.shape[2])
        return metric

    def _block(
        self,
        loop: Feedback,
        values: Float[Array, "width parameters"],
        reference: Float[Array, "runs samples *axes"],
        run_noise: RunNoise,
    ) -> dict[str, Any]:
        """Return the results of a block as arrays [runs, width, ...].

        The sensitivity is returned as the arrays of ``_peaks`` [width, branches, ...].
        """
        paths = [axis.path for axis in self.plan.axes]
        metric, every = self._metric(), self.every

        def loop_at(values):
            return Watched(replace(loop, dict(zip(paths, values, strict=True))))

        def run(drives):
            reference, run_noise = drives
            inputs = loop_inputs(reference, *run_noise)

            def figures(values):
                system = loop_at(values)
                state = system.init(reference[0])
                return metered(system, inputs, state, metric)[0]

            if every is None:
                return jax.vmap(figures)(values)
            step = every

            def simulate_point(values):
                both = WithMetric(loop_at(values), metric)
                end, log = simulate(both, inputs, both.init(reference[0]), every=step)
                signals = {name: packed(getattr(log, name)) for name in TRAJECTORIES}
                # The data set has time as its last dimension.
                signals = {name: jnp.moveaxis(x, 0, -1) for name, x in signals.items()}
                return metric.result(end[1]), signals

            found, log = jax.vmap(simulate_point)(values)
            return found | log

        results = jax.lax.map(run, (reference, run_noise))
        if SENSITIVITY in self.metrics:
            results[SENSITIVITY] = in_blocks(
                lambda v: self._peaks(loop_at(v).loop), values
            )
        names = (*self.metrics, *(TRAJECTORIES if self.every else ()))
        return {name: results[name] for name in names}

    def _peaks(self, loop: Feedback) -> tuple[Array, Array]:
        """Return Ms and the state matrix of the closed loop, both for every branch."""
        point = OperatingPoint(self.case.margin_reference, dt=self.case.study.dt)
        found = sensitivities(loop, point, self._margin_duration)
        peaks = jax.vmap(peak_of)(found)
        return peaks, closed_matrices(loop, point)

    def _program(self, device: Any, plant: str) -> Callable:
        """Return the compiled program that simulates a plant on a device."""
        # The lock keeps two threads from compiling the same program.
        with self._lock:
            if device not in self._inputs:
                self._inputs[device] = jax.device_put(
                    (self.reference, self.run_noise), device
                )
            key = device, plant
            if key not in self._programs:
                stage = Stage(self.plants[plant], self.case.loop.sensor)
                loop = jax.device_put(stage.around(self.case.loop), device)
                values = jax.device_put(
                    jnp.zeros((self.plan.width, len(self.plan.axes))), device
                )
                program = jax.jit(self._block)
                compiled = program.lower(loop, values, *self._inputs[device]).compile()
                self._programs[key] = lambda values: compiled(
                    loop, values, *self._inputs[device]
                )
            return self._programs[key]

    def compile(self, device: Any) -> None:
        """Compile all programs of a device; ``chunk`` compiles the missing ones."""
        for plant in self.plants:
            self._program(device, plant)

    def chunk(
        self,
        index: int,
        device: Any = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> dict[str, np.ndarray] | None:
        """Return the results of a chunk, or None if ``stopped`` returns True meanwhile.

        The results are arrays [points, plants, references, draws, ...]; the sensitivity
        is [points, plants]. Copies of the last point fill the last block.
        """
        device = jax.devices()[0] if device is None else device
        start, stop = self.plan.span(index)
        values = self.plan.values(start, stop)
        width = self.plan.width
        parts: list[list[dict[str, np.ndarray]]] = []
        for plant in self.plants:
            program = self._program(device, plant)
            parts.append([])
            for first in range(0, stop - start, width):
                if stopped():
                    return None
                places = np.minimum(np.arange(first, first + width), stop - start - 1)
                results = program(jax.device_put(values[places], device))
                if SENSITIVITY in results:
                    results[SENSITIVITY] = _worse_peak(*results[SENSITIVITY])
                parts[-1].append({name: np.asarray(x) for name, x in results.items()})
        return {
            name: self._concatenated(name, [[b[name] for b in p] for p in parts])[
                : stop - start
            ]
            for name in parts[0][0]
        }

    def _concatenated(
        self, name: str, parts: Sequence[Sequence[np.ndarray]]
    ) -> np.ndarray:
        if name == SENSITIVITY:
            return np.stack([np.concatenate(blocks) for blocks in parts], axis=1)
        # [plants, runs, points, ...] to [points, plants, references, draws, ...].
        whole = np.stack([np.concatenate(blocks, axis=1) for blocks in parts])
        whole = np.moveaxis(whole, 2, 0)
        shape = (*whole.shape[:2], len(self.references), self.draws, *whole.shape[3:])
        return np.ascontiguousarray(whole.reshape(shape))


def _worse_peak(peaks: Any, closed: Any) -> np.ndarray:
    """Return Ms [points] of the worse branch from ``peaks`` [points, branches].

    It is inf if ``closed`` [points, branches, order, order] has a pole outside the unit
    circle, and NaN if ``closed`` is not finite.
    """
    peaks, closed = np.asarray(peaks), np.asarray(closed)
    worse = np.where(stable(poles_of(closed)), peaks.max(axis=-1), np.inf)
    return np.where(np.isfinite(closed).all((-3, -2, -1)), worse, np.nan)
