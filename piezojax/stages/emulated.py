"""Emulated stage: a loop with its own clock, guard, noise and faults."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..control.guard import REASONS, Guard
from ..core.arrays import as_array
from ..core.feedback import Feedback, LoopInput, LoopSample, LoopState, Observation
from ..core.paths import get, replace, scalars
from ..core.rollout import simulate
from ..core.system import System, resolve
from ..identification import Record
from ..study.parameters import check_value
from .faults import FailingSensor, Fault, sensor_faults
from .protocol import Gains, StoppedError

BLOCK = 200
"""Number of samples between two checks of the guard and of requests to stop."""

APPROACH = 0.1
"""Duration of the move to the beginning of a reference, and of the rest there, s."""

LONGEST_HOLD = 0.5
"""Longest simulated time between two runs, s."""

ASKED = "it was asked to stop"

RETREATING = len(REASONS)
"""Number of the reason of a guard that retreats without a fault."""


@dataclass(frozen=True)
class Limits:
    """Limits of the guard of a stage; the fields are those of a Guard.

    ``retreat`` is the safe voltage, V, to which the stage moves after a stop.
    """

    lower: float
    upper: float
    slew: float
    largest_error: float
    retreat: float
    patience: int = 20
    unseen: float = 2.0


@dataclass
class EmulatedStage:
    """Simulated stage of ``controller``, ``plant``, ``actuator`` and ``sensor``.

    The ``plant`` may differ from the model on which gains are tuned. ``safe_gains`` are
    set at the beginning and after a stop. ``drift`` is the rms value of a random walk
    of the position after 1 s, um. ``faults`` occur in the next run. Between runs, the
    stage is simulated for the time that passes on the ``clock`` (s), at most
    ``LONGEST_HOLD``. ``speed`` is the duration of a run relative to real time: 2 takes
    twice as long, 0 runs as fast as possible.
    """

    controller: System
    plant: System
    actuator: System
    sensor: System
    limits: Limits
    dt: float
    safe_gains: Gains = field(default_factory=dict)
    drift: float = 0.0
    seed: int = 0
    speed: float = 0.0
    clock: Callable[[], float] = time.monotonic
    faults: Sequence[Fault] = ()

    def __post_init__(self):
        self._random = np.random.default_rng(self.seed)
        self._one_at_a_time = threading.RLock()
        self._one_request = threading.Lock()
        self._stop = threading.Event()
        self._walk, self._seen = 0.0, self.clock()
        self._check(self.safe_gains)
        controller = replace(self.controller, _arrays(self.safe_gains))
        self._loop = Feedback(
            self._guarded(controller),
            self.plant,
            self.actuator,
            FailingSensor(self.sensor),
        )
        self._state = self._loop.init(0.0, as_array(self.limits.retreat))
        self._restart()

    def run(self, reference: Float[np.ndarray, " samples"], gains: Gains) -> Record:
        """Follow ``reference`` (um) with ``gains``, as ``Stage.run`` describes.

        Also raises ValueError for a reference that is empty or not a row of numbers.
        """
        reference = np.asarray(reference, dtype=float)
        if reference.ndim != 1 or not np.all(np.isfinite(reference)):
            raise ValueError("reference must be a row of numbers, in um")
        if not reference.size:
            raise ValueError("reference has 0 samples; give at least one, in um")
        with self._one_at_a_time:
            self.apply(gains)
            faults, self.faults = tuple(self.faults), ()
            here = float(self._state.controller.measured)
            self._follow(_approach(here, reference[0], self.dt), ())
            # At sample k the loop receives the reference of sample k + 1.
            found = self._follow(np.append(reference[1:], reference[-1]), faults)
        return Record(
            found.voltage,
            found.measured,
            self.dt,
            source="emulated stage",
            reference=found.reference,
        )

    def apply(self, gains: Gains) -> None:
        """Set ``gains`` and hold the position."""
        with self._one_at_a_time:
            self._check(gains)
            self._wait()
            self._set(replace(self._controller, _arrays(gains)))

    def gains(self) -> dict[str, float]:
        """Return the scalar parameters of the controller by path."""
        return scalars(self._controller)

    def safe(self) -> None:
        """Stop a run under way, set the safe gains and move to the safe voltage."""
        # One request at a time, so that none clears the request of another thread.
        with self._one_request:
            self._stop.set()
            with self._one_at_a_time:
                self._retreat()
                self._stop.clear()

    @property
    def voltage(self) -> float:
        """Voltage at the actuator, V."""
        return float(self._state.voltage)

    @property
    def _controller(self) -> System:
        guard = self._loop.controller
        assert isinstance(guard, Guard)
        return guard.controller

    def _guarded(self, controller: System) -> Guard:
        return Guard(controller, **vars(self.limits), dt=self.dt)

    def _check(self, gains: Gains) -> None:
        for path, value in gains.items():
            if not isinstance(value, int | float) or not np.isfinite(value):
                raise ValueError(f"gains.{path} is {value!r}; it must be a number")
            get(self.controller, path)
            check_value(self.controller, path, value, f"gains.{path}")

    def _set(self, controller: System) -> None:
        """Put ``controller`` behind the guard, and start it where the stage is now."""
        self._loop = eqx.tree_at(
            lambda loop: loop.controller, self._loop, self._guarded(controller)
        )
        self._restart()

    def _restart(self) -> None:
        """Start the controller at rest, where the stage is now."""
        state = self._state
        here = jnp.where(
            jnp.isfinite(state.displacement), state.displacement, as_array(0.0)
        )
        observation = Observation(here, here, here, state.voltage)
        controller = resolve(self._loop.controller).init(observation)
        self._state = state._replace(controller=controller, reference=here)

    def _wait(self) -> None:
        """Hold the position for the time since the last run."""
        now = self.clock()
        gone, self._seen = min(max(now - self._seen, 0.0), LONGEST_HOLD), now
        samples = round(gone / self.dt) // BLOCK * BLOCK
        if samples:
            reference = float(self._state.reference)
            self._advance(np.full(samples, reference), np.zeros(samples))

    def _follow(
        self, reference: Float[np.ndarray, " samples"], faults: tuple[Fault, ...]
    ) -> LoopSample:
        """Follow ``reference``; raise StoppedError at a fault or a request to stop."""
        samples = len(reference)
        padded = np.concatenate([reference, np.full(-samples % BLOCK, reference[-1])])
        codes, blocks = sensor_faults(faults, len(padded)), []
        begin = time.monotonic()
        for first in range(0, len(padded), BLOCK):
            here = slice(first, first + BLOCK)
            for fault in faults:
                if fault.kind == "plant" and first <= fault.begin < here.stop:
                    self._loop = eqx.tree_at(
                        lambda loop: loop.plant, self._loop, fault.plant
                    )
            blocks.append(self._advance(padded[here], codes[here]))
            reason = int(self._state.controller.reason)
            if reason or self._stop.is_set():
                found = _joined(blocks, samples)
                self._retreat()
                raise StoppedError(
                    REASONS[reason] or ASKED,
                    found.reference,
                    found.measured,
                    found.voltage,
                )
            if self.speed:
                due = begin + self.speed * (first + BLOCK) * self.dt
                self._stop.wait(max(0.0, due - time.monotonic()))
        self._seen = self.clock()
        return _joined(blocks, samples)

    def _advance(self, reference: np.ndarray, codes: np.ndarray) -> LoopSample:
        """Step the loop through ``reference``, in blocks; return its samples."""
        samples = len(reference)
        draws = self._random.standard_normal(samples)
        steps = self._random.standard_normal(samples) * self.drift * np.sqrt(self.dt)
        walk = self._walk + np.cumsum(steps)
        self._walk = float(walk[-1])
        blocks = []
        for first in range(0, samples, BLOCK):
            here = slice(first, first + BLOCK)
            inputs = LoopInput(
                as_array(reference[here]),
                (as_array(draws[here]), as_array(codes[here])),
                as_array(walk[here]),
            )
            self._state, found = _block(self._loop, self._state, inputs)
            blocks.append(found)
        return _joined(blocks, samples)

    def _retreat(self) -> None:
        """Set the safe gains; let the guard move the stage to the safe voltage."""
        self._set(replace(self.controller, _arrays(self.safe_gains)))
        reason = jnp.asarray(RETREATING, jnp.int32)
        stopped = self._state.controller._replace(reason=reason)
        self._state = self._state._replace(controller=stopped)
        way = abs(self.voltage - self.limits.retreat)
        samples = int(way / (self.limits.slew * self.dt)) + 1
        samples += -samples % BLOCK
        self._advance(np.full(samples, float(self._state.reference)), np.zeros(samples))
        self._seen = self.clock()


def _approach(here: float, there: float, dt: float) -> Float[np.ndarray, " samples"]:
    """Return a smooth move from ``here`` to ``there`` (um), and a rest as long."""
    samples = max(1, round(APPROACH / dt))
    share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, samples + 1) / samples)
    return np.concatenate([here + (there - here) * share, np.full(samples, there)])


def _arrays(gains: Gains) -> Mapping[str, Any]:
    return {path: as_array(value) for path, value in gains.items()}


@eqx.filter_jit
def _block(
    loop: Feedback, state: LoopState, inputs: LoopInput
) -> tuple[LoopState, LoopSample]:
    return simulate(loop, inputs, state)


def _joined(blocks: Sequence[LoopSample], samples: int) -> LoopSample:
    """Return the first ``samples`` of ``blocks`` as arrays."""
    columns = zip(*blocks, strict=True)
    return LoopSample(
        *(np.concatenate([np.asarray(x) for x in each])[:samples] for each in columns)
    )
