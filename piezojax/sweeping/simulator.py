"""Simulation of a sweep: one program, called for block after block of points."""

import dataclasses
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.stability import OperatingPoint, open_loop
from ..analysis.stability.differentiable import peak_of, sensitivities
from ..analysis.stability.operating_point import BRANCHES
from ..core.arrays import State
from ..core.axes import PerAxisMetric, packed
from ..core.metrics import Tracking
from ..core.paths import replace
from ..core.rollout import Metric, simulate
from ..core.system import Feedback, LoopSample, System, loop_inputs
from ..signals.waveforms import time_grid
from ..study import Case, Stage
from ..study.sweep_table import SENSITIVITY
from ..tuning.data import make_data
from .plan import TRAJECTORIES, Plan, plants_of, references_of, swept

_OUTSIDE = 1e-6  # of the unit circle: hysteresis remembers at 1, to rounding


class Metered(System):
    """A loop that accumulates a metric beside its state, so that one run gives both."""

    loop: Feedback
    metric: Metric

    def init(self, input: Any = 0.0) -> State:
        zero = jnp.zeros((), jnp.int32)
        return self.loop.init(input), self.metric.init(), zero

    def step(self, state: State, input: Any) -> tuple[State, LoopSample]:
        inner, total, index = state
        inner, output = self.loop.step(inner, input)
        return (inner, self.metric.update(total, index, output), index + 1), output


class Simulator:
    """Simulates chunks of the plan of a case.

    References and noise are those of the study's hold-out, the same for every point: a
    block is ``plan.width`` points that follow one reference. So a run of a hundred
    thousand points reads no more inputs than one.
    """

    def __init__(self, case: Case):
        self.case, self.plan = case, Plan(case)
        study, table = case.study, swept(case.study)
        self.plants = plants_of(case)
        self.references = references_of(study)
        self.metrics, self.every = table.metrics, table.every
        if SENSITIVITY in self.metrics and study.axes:
            raise ValueError(
                f"sweep.metrics: {SENSITIVITY} is there for a stage with one axis"
            )
        data = make_data(case).holdout
        every = (*study.references.tune, *study.references.unseen)
        chosen = np.array([every.index(name) for name in self.references])
        # One row a run: each reference as often as there are draws of noise.
        self.draws = data.noise.shape[1]
        self.reference = data.references[np.repeat(chosen, self.draws)]
        self.noise = data.noise[chosen].reshape(self.reference.shape)
        self.disturbance = (
            None
            if data.disturbance is None
            else data.disturbance[chosen].reshape(self.reference.shape)
        )
        self.start = round(study.references.settle * study.rate)
        self.samples = self.reference.shape[1]
        self._programs: dict[Any, Callable] = {}
        self._inputs: dict[Any, Any] = {}
        self._lock = threading.Lock()

    @property
    def lane_steps(self) -> int:
        """Simulated samples of a point, its plants and runs together."""
        return self.samples * self.reference.shape[0] * len(self.plants)

    def times(self) -> np.ndarray | None:
        """Return the instants (s) of kept samples; None if none are kept."""
        if self.every is None:
            return None
        study = self.case.study
        return np.asarray(time_grid(study.references.duration, study.rate))[
            :: self.every
        ]

    def _metric(self) -> Metric:
        metric: Metric = Tracking(start=self.start)
        if self.reference.ndim > 2:
            metric = PerAxisMetric(metric, self.reference.shape[2])
        return metric

    def _block(
        self,
        loop: Feedback,
        values: Float[Array, "width parameters"],
        reference: Float[Array, "runs samples *axes"],
        noise: Float[Array, "runs samples *axes"],
        disturbance: Float[Array, "runs samples *axes"] | None,
    ) -> dict[str, Any]:
        """Return the kept results of each run: arrays [runs, width, ...].

        Of the sensitivity those of ``_peaks``, [width, branches, ...].
        """
        paths = [axis.path for axis in self.plan.axes]
        metric = self._metric()

        def of_point(values):
            return replace(loop, dict(zip(paths, values, strict=True)))

        def run(signals):
            reference, noise, disturbance = signals
            inputs = loop_inputs(reference, noise, disturbance)

            def one(values):
                system, first = of_point(values), reference[0]
                if self.every is None:
                    start = system.init(first)
                    return simulate(
                        system, inputs, start, metric=metric, segment=self.samples
                    )[1], {}
                metered = Metered(system, metric)
                end, log = simulate(
                    metered, inputs, metered.init(first), every=self.every
                )
                kept = {name: packed(getattr(log, name)) for name in TRAJECTORIES}
                # Time last, as in the data set.
                kept = {name: jnp.moveaxis(x, 0, -1) for name, x in kept.items()}
                return metric.result(end[1]), kept

            figures, log = jax.vmap(one)(values)
            return figures._asdict() | log

        found = jax.lax.map(run, (reference, noise, disturbance))
        if SENSITIVITY in self.metrics:
            found[SENSITIVITY] = jax.vmap(lambda v: self._peaks(of_point(v)))(values)
        names = (*self.metrics, *(TRAJECTORIES if self.every else ()))
        return {name: found[name] for name in names}

    def _peaks(self, loop: Feedback) -> tuple[Array, Array]:
        """Return Ms and the matrix of the closed loop, both on every branch."""
        point = OperatingPoint(self.case.study.highest, dt=self.case.study.dt)
        models = [
            open_loop(loop, dataclasses.replace(point, branch=name))
            for name in BRANCHES
        ]
        return (
            jax.vmap(peak_of)(sensitivities(loop, point)),
            jnp.stack([model.A - model.B @ model.C for model in models]),
        )

    def _on(self, device: Any, plant: str) -> Callable:
        """Return the program of a plant on a device: points to what is kept."""
        # One thread at a time: two would compile the same.
        with self._lock:
            if device not in self._inputs:
                self._inputs[device] = jax.device_put(
                    (self.reference, self.noise, self.disturbance), device
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
        """Compile what runs on a device, once; ``chunk`` does so when it has to."""
        for plant in self.plants:
            self._on(device, plant)

    def chunk(
        self,
        index: int,
        device: Any = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> dict[str, np.ndarray] | None:
        """Return what is kept of a chunk, or None if ``stopped`` in the midst of it.

        Arrays [points, plants, references, draws, ...], the sensitivity [points,
        plants]. The last block is filled up with copies of its last point.
        """
        device = jax.devices()[0] if device is None else device
        start, stop = self.plan.span(index)
        values = self.plan.values(start, stop)
        width = self.plan.width
        parts: list[list[dict[str, np.ndarray]]] = []
        for plant in self.plants:
            program = self._on(device, plant)
            parts.append([])
            for first in range(0, stop - start, width):
                if stopped():
                    return None
                places = np.minimum(np.arange(first, first + width), stop - start - 1)
                found = program(jax.device_put(values[places], device))
                if SENSITIVITY in found:
                    found[SENSITIVITY] = _worse(*found[SENSITIVITY])
                parts[-1].append({name: np.asarray(x) for name, x in found.items()})
        return {
            name: self._joined(name, [[b[name] for b in p] for p in parts])[
                : stop - start
            ]
            for name in parts[0][0]
        }

    def _joined(self, name: str, parts: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
        if name == SENSITIVITY:
            return np.stack([np.concatenate(blocks) for blocks in parts], axis=1)
        # [plants, runs, points, ...] to [points, plants, references, draws, ...].
        whole = np.stack([np.concatenate(blocks, axis=1) for blocks in parts])
        whole = np.moveaxis(whole, 2, 0)
        shape = (*whole.shape[:2], len(self.references), self.draws, *whole.shape[3:])
        return np.ascontiguousarray(whole.reshape(shape))


def _worse(peaks: Any, closed: Any) -> np.ndarray:
    """Return Ms [points] of the worse branch from ``peaks`` [points, branches].

    It is infinite where ``closed`` [points, branches, order, order] has a pole outside
    the unit circle, NaN where that is not finite. In NumPy: XLA may wait for LAPACK
    without end on a CPU.
    """
    peaks, closed = np.asarray(peaks), np.asarray(closed)
    finite = np.isfinite(closed).all((-3, -2, -1))
    poles = np.linalg.eigvals(np.where(finite[:, None, None, None], closed, 0.0))
    stable = (np.abs(poles) <= 1.0 + _OUTSIDE).all(axis=-1)
    worse = np.where(stable, peaks, np.inf).max(axis=-1)
    return np.where(finite, worse, np.nan)
