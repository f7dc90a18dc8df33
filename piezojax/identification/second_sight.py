"""Linear dynamics that several records show once their hysteresis is fitted.

The plays with which ``linear_dynamics`` describes a hysteresis are few. Their errors
bias its modes and lag, and may hide a weak second mode. The output of a fitted
hysteresis takes the place of these plays at second sight.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..core.paths import get, replace
from ..core.progress import Progress
from ..core.system import Series, System, series
from .chain import LINEAR, by_evidence, dynamics_of, structure
from .estimators.approach import run_after
from .estimators.free_runs import starts_of
from .estimators.output_error import ROUGH_STEPS, output_error
from .estimators.resonances import LinearDynamics, dynamics_behind
from .estimators.structure import Structure
from .records.record import Record

LOOKS = 3
"""Most looks, each after a rough fit with the dynamics of the one before."""

NEAR_LAG, NEAR_DAMPING = 0.05, 0.2
"""Relative changes of lags and damping ratios that need no further look."""


class Seen(NamedTuple):
    """A chain to fit, and the dynamics from which its bounds and starts follow."""

    structure: Structure
    shown: LinearDynamics


def seen_again(
    model: str,
    records: Sequence[Record],
    train: slice,
    progress: Progress,
    shown: LinearDynamics | None = None,
    looks: int = LOOKS,
) -> Seen:
    """Return the chain ``model`` with the dynamics that show behind its hysteresis.

    A rough fit to the samples ``train`` of the ``records`` gives the hysteresis, and
    the only start of the structure. The first one has the dynamics ``shown``, by
    default those at first sight. If there is no resonance at first sight, the structure
    is that of ``chain.structure``.
    """
    first, *beside = by_evidence(records, train)
    shown = shown or dynamics_of(first)
    shape = structure(model, first, beside=beside, shown=shown)
    for _ in range(looks if shape.whitening else 0):
        rough = output_error(
            shape, records, train, steps=ROUGH_STEPS, progress=progress, passes=1
        )
        last, found = shown, _best(rough.system, [first, *beside], train)
        if not found.modes:
            break
        shown = found._replace(
            slope=last.slope, slew=last.slew, input_unit=last.input_unit
        )
        again = structure(model, first, beside=beside, shown=shown)
        kept = set(rough.problem.space.paths) & set(again.space.paths)
        values = {path: get(rough.system, path) for path in kept - set(again.dynamics)}
        start = again.space.nearest(replace(again.system, values))
        system = again.system
        if again.linear:
            fitted = get(rough.system, again.linear.path)
            system = replace(system, {again.linear.path: fitted})
        shape = again._replace(system=system, starts=start[None], guess=again.starts[0])
        if _equal(shown, last):
            break
    return Seen(shape, shown)


def _equal(one: LinearDynamics, other: LinearDynamics) -> bool:
    """Return whether modes and lags agree within the narrowest bounds of a fit."""
    if (len(one.modes), len(one.lags)) != (len(other.modes), len(other.lags)):
        return False
    lags = np.allclose(one.lags, other.lags, rtol=NEAR_LAG)
    damping = [[mode.damping for mode in each.modes] for each in (one, other)]
    return lags and np.allclose(*damping, rtol=NEAR_DAMPING)


def _best(system: System, records: Sequence[Record], train: slice) -> LinearDynamics:
    """Return the dynamics with the most modes; if equal, those of the first record."""
    assert isinstance(system, Series)
    parts = dict(zip(system.names, system.parts, strict=True))
    place = next(i for i, name in enumerate(system.names) if name in LINEAR)
    front = series(**{name: parts[name] for name in system.names[:place]})
    starts, _, _ = starts_of(system, records, train)
    found = []
    for record, start in zip(records, starts, strict=True):
        run = np.asarray(run_after(front, jnp.asarray(record.input), start.levels))
        # A plant maps u(k) to y(k+1): the sample of delay belongs to the dynamics.
        ahead = np.append(run[1:], run[-1])
        found.append(dynamics_behind(ahead, record.output, record.dt))
    return max(found, key=lambda each: len(each.modes))
