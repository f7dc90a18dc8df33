"""Simulations of a tuned loop with gains near the tuned ones."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats.qmc

from ..analysis.constraints import CONSTRAINTS
from ..analysis.loop_figures import margin_figures
from ..analysis.stability.operating_point import OperatingPoint
from ..analysis.step_response import NAMES, step_ends
from ..core.arrays import as_array
from ..core.rollout import in_blocks
from ..core.space import Space
from ..solve.multi_start import in_batches
from .data import holding_inputs, own_stage
from .objective import RAILED
from .outcome import Outcome
from .runs import Signals, sampled

BATCH = 32
"""Number of gain sets that are simulated at once."""

WIDEST = 2.0
"""Largest factor between a gain on a logarithmic scale and the ends of its range."""

WIDEST_SHARE = 0.25
"""Largest distance of the ends from any tuned gain, as a share of the unit box."""

SAMPLES = 1000
"""Approximate largest number of samples kept of a run: every n-th, n at least 2."""

LARGEST_PEAK = 5.0
"""Largest sensitivity peak of a gain set that counts as stable."""

STEP = NAMES[0]
"""The step that is simulated: the small one, which no voltage limit distorts."""


class Margin(NamedTuple):
    """A margin of ``CONSTRAINTS``."""

    constraint: str

    @property
    def unlimited(self) -> float:
        """Value of the margin if nothing limits it."""
        return CONSTRAINTS[self.constraint].unlimited

    @property
    def unit(self) -> str:
        """Unit of the margin."""
        return CONSTRAINTS[self.constraint].unit

    def worst(self, values: jax.Array) -> jax.Array:
        """Return the worst of ``values`` over all branches and bands."""
        at_most = CONSTRAINTS[self.constraint].sense == "at most"
        return jnp.max(values) if at_most else jnp.min(values)


MARGINS = {
    "sensitivity peak": Margin("sensitivity_peak"),
    "gain margin": Margin("gain_margin"),
    "phase margin": Margin("phase_margin"),
    "delay margin": Margin("delay_margin"),
}
"""Margins of a gain set by name."""

_HALVINGS = 8


class Simulated(NamedTuple):
    """Simulated gain sets, which are on the first axis of each array.

    ``errors`` [sets, references, values] are the tracking errors (um) of all draws,
    scaled so that their norm is their rms. ``step`` [sets, samples] is a displacement
    (um). ``margins`` [sets, margins] are those of ``MARGINS``. ``stable`` is False for
    a set that diverges, stays at a voltage limit, or has a sensitivity peak above
    ``LARGEST_PEAK``.
    """

    errors: np.ndarray
    step: np.ndarray
    margins: np.ndarray
    stable: np.ndarray


class NearGains(NamedTuple):
    """Simulated gain sets between ``lower`` and ``upper``, all of them stable.

    ``places`` [sets, gains] run from 0 to 1 in that range. The first ``BATCH`` sets are
    random; then come the tuned set, the sets with one gain at an end of its range, and
    further random ones. ``times`` (s) are those of the step.
    """

    lower: np.ndarray
    upper: np.ndarray
    places: np.ndarray
    simulated: Simulated
    times: np.ndarray


def simulate_near(outcome: Outcome) -> NearGains | None:
    """Simulate gain sets near the tuned one of ``outcome``, on one axis.

    The range is halved until every set is stable; None if one is not stable in the
    smallest range either. The plant is the nominal one, references and noise are those
    of the hold-out, and the margins are those at the ``margin_reference``.
    """
    space, seed = outcome.case.space, outcome.case.study.seed
    tuned = np.asarray(space.to_unit(as_array([*outcome.result.gains.values()])))
    half = _widest(space)
    random = _random_places(len(tuned), seed)
    program, times = _program(outcome)
    for _ in range(_HALVINGS):
        lower, upper = np.maximum(tuned - half, 0.0), np.minimum(tuned + half, 1.0)
        own = (tuned - lower) / (upper - lower)
        places = np.concatenate([random[:BATCH], own[None], _ends(own), random[BATCH:]])
        found = _all_stable(program, lower + (upper - lower) * places)
        if found is not None:
            return NearGains(lower, upper, places, found, times)
        half = half / 2.0
    return None


def _widest(space: Space) -> np.ndarray:
    """Return the largest distance [gains] of a range's ends from the tuned gains."""
    return np.array(
        [
            min(WIDEST_SHARE, math.log(WIDEST) / math.log(bounds.upper / bounds.lower))
            if bounds.scale == "log"
            else WIDEST_SHARE
            for bounds in space.ranges().values()
        ]
    )


def _random_places(gains: int, seed: int) -> np.ndarray:
    """Return ``BATCH`` places for the test, and the random ones to interpolate."""
    sampler = scipy.stats.qmc.Halton(gains, rng=np.random.default_rng(seed))
    interpolated = BATCH * min(max(gains, 2), 8)
    return sampler.random(BATCH + interpolated - 1 - 2 * gains)


def _ends(own: np.ndarray) -> np.ndarray:
    """Return copies of ``own`` with one value moved to 0 or 1, without unmoved ones."""
    moved = np.eye(own.size, dtype=bool)
    places = np.concatenate([np.where(moved, end, own) for end in (0.0, 1.0)])
    return places[np.any(places != own, axis=1)]  # equal centres cannot be interpolated


def _all_stable(program: Callable, units: np.ndarray) -> Simulated | None:
    """Return the simulated sets, or None as soon as one of them is not stable."""
    found = []
    for first in range(0, len(units), BATCH):
        batch = units[first : first + BATCH]
        found.append(Simulated(*in_batches(program, batch, BATCH)))
        if not np.all(found[-1].stable):
            return None
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def _program(outcome: Outcome) -> tuple[Callable, np.ndarray]:
    """Return the simulator of ``BATCH`` gain sets, and the times of its step."""
    case, space, loop = outcome.case, outcome.case.space, outcome.after
    study, signals = case.study, outcome.holdout
    start, samples = study.settled, signals.references.shape[1]
    every = max(2, math.ceil((samples - start) / SAMPLES))
    kept = every * np.arange(start // every, samples // every) + every - 1
    before, after = step_ends(np.asarray(signals.references))[NAMES.index(STEP)]
    step = np.where(np.arange(samples) > kept[0], after, before)
    signals = _with_run(signals, as_array(step), outcome)
    point = OperatingPoint(case.margin_reference, dt=study.dt)
    names, duration = [m.constraint for m in MARGINS.values()], case.margin_duration

    def one(unit: jax.Array) -> tuple[jax.Array, ...]:
        around = space.put(loop, unit)
        figures, errors = sampled(
            lambda loop: loop, around, signals, start, every=every
        )
        assert errors is not None
        of = margin_figures(names, around, point, None, duration)
        margins = jnp.stack([m.worst(of[m.constraint]) for m in MARGINS.values()])
        tracking = errors[:-1].reshape(len(errors) - 1, -1)
        rms = jnp.sqrt(jnp.mean(figures.rms_error[:-1] ** 2, axis=1))
        size = jnp.linalg.norm(tracking, axis=1)
        found = (
            tracking * (rms / size)[:, None],
            errors[-1, 0] + step[kept],
            margins,
        )
        finite = jnp.stack([jnp.all(jnp.isfinite(x)) for x in found])
        usable = jnp.all(figures.saturated <= RAILED) & (margins[0] <= LARGEST_PEAK)
        return *found, usable & jnp.all(finite)

    program = jax.jit(lambda units: in_blocks(one, units, size=BATCH // 4))
    return program, (kept - kept[0] - 1) * study.dt


def _with_run(signals: Signals, reference: jax.Array, outcome: Outcome) -> Signals:
    """Return ``signals`` and a run of ``reference``, with noise and disturbances 0."""
    noise = jax.tree.map(
        lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])]), signals.run_noise
    )
    references = jnp.concatenate([signals.references, reference[None]])
    (holding,) = holding_inputs(own_stage(outcome.after), references[:, 0])
    more = {"references": references, "holding": holding, "traces": ()}
    return dataclasses.replace(signals, **more, **noise._asdict())
