"""Linear dynamics that several records show once their hysteresis is fitted.

The plays with which ``linear_dynamics`` describes a hysteresis are few. Their errors
bias its modes and lag, and may hide a weak second mode. The output of a fitted
hysteresis takes the place of these plays at second sight.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.arrays import as_array
from ..core.paths import get, replace
from ..core.progress import Progress
from ..core.system import Series, System, series
from .chain import DRIVE, LINEAR, SLEW, by_evidence, dynamics_of, structure
from .estimators.approach import run_after
from .estimators.output_error import ROUGH_STEPS, Optimum, output_error
from .estimators.resonances import LinearDynamics, dynamics_behind, slew_behind
from .estimators.slew_rate import slewed
from .estimators.structure import Structure
from .records.record import Record

LOOKS = 3
"""Most looks, each after a rough fit with the dynamics of the one before."""

NEAR_LAG, NEAR_DAMPING = 0.05, 0.2
"""Relative changes of lags, of the slew rate, and of damping ratios that need no
further look."""


class Seen(NamedTuple):
    """A chain to fit, and the dynamics from which its bounds and starts follow.

    ``fit`` is the one behind which they showed; it has found the states before the
    records.
    """

    structure: Structure
    shown: LinearDynamics
    fit: Optimum | None = None


class Begun(NamedTuple):
    """A fit of a chain to several records whose dynamics are ``shown``."""

    fit: Optimum
    shown: LinearDynamics


def fit_seen(
    model: str,
    records: Sequence[Record],
    train: slice,
    steps: int,
    progress: Progress,
    begun: Begun | None = None,
) -> tuple[Optimum, Seen]:
    """Fit the chain ``model`` with the dynamics that show behind its hysteresis.

    The arguments are those of ``seen_again`` and ``output_error``. The fit goes on from
    one that was ``begun`` with the first samples of the same records. A weak mode or
    the slew rate may show only behind the hysteresis of the last fit: the chain is then
    fitted with it, too.
    """
    ordered = by_evidence(records, train)

    def fit(seen: Seen) -> Optimum:
        return output_error(
            seen.structure,
            ordered,
            train,
            steps=steps,
            progress=progress,
            begun=seen.fit,
        )

    if begun is None:
        seen = seen_again(model, ordered, train, progress)
    else:
        seen = seen_behind(begun, model, ordered)
    optimum = fit(seen)
    if seen.structure.whitening:
        more = seen_behind(Begun(optimum, seen.shown), model, ordered)
        if not _equal(more.shown, seen.shown):
            wider = fit(more)
            if wider.losses[0] < optimum.losses[0]:
                return wider, more
    return optimum, seen


def seen_again(
    model: str,
    records: Sequence[Record],
    train: slice,
    progress: Progress,
    looks: int = LOOKS,
) -> Seen:
    """Return the chain ``model`` with the dynamics that show behind its hysteresis.

    A rough fit to the samples ``train`` of the ``records``, which are sorted
    ``by_evidence``, gives the hysteresis, and the only start of the structure. The
    first one has the dynamics at first sight. If there is no resonance at first sight,
    the structure is that of ``chain.structure``.
    """
    first, *beside = records
    shown = dynamics_of(first)
    seen = Seen(structure(model, first, beside=beside, shown=shown), shown)
    for _ in range(looks if seen.structure.whitening else 0):
        rough = output_error(
            seen.structure,
            records,
            train,
            steps=ROUGH_STEPS,
            progress=progress,
            passes=1,
            begun=seen.fit,
        )
        last, seen = seen, seen_behind(Begun(rough, seen.shown), model, records)
        if seen.structure.linear is not None:
            # A single pass with linear weights has not searched for the states.
            seen = seen._replace(fit=None)
        if _equal(seen.shown, last.shown):
            break
    return seen


def seen_behind(begun: Begun, model: str, records: Sequence[Record]) -> Seen:
    """Return what shows behind the hysteresis of a fit to ``records``.

    The chain starts at this fit. Its dynamics stay if no resonance shows.
    """
    fit, last = begun
    (first, *beside), behind = records, _best(fit, records)
    shown = last
    if behind.modes:
        slew = last.slew if behind.slew is None else behind.slew
        shown = behind._replace(slope=last.slope, slew=slew, input_unit=last.input_unit)
    again = structure(model, first, beside=beside, shown=shown)
    both = set(fit.problem.space.paths) & set(again.space.paths)
    # A value that is kept may lie outside its new bounds, where a descent is stuck.
    anew = {*again.dynamics, *([] if behind.slew is None else [SLEW])}
    values = {path: get(fit.system, path) for path in both - anew}
    system = again.system
    found = again.space.put(system, as_array(again.starts[0]))
    start = again.space.nearest(replace(found, values))
    if again.linear:
        weights = get(fit.system, again.linear.path)
        system = replace(system, {again.linear.path: weights})
    shape = again._replace(system=system, starts=start[None], guess=again.starts[0])
    return Seen(shape, shown, fit)


def _equal(one: LinearDynamics, other: LinearDynamics) -> bool:
    """Return whether both agree within the narrowest bounds of a fit."""
    if (len(one.modes), len(one.lags)) != (len(other.modes), len(other.lags)):
        return False
    both = one, other
    times = [
        [*each.lags, 0.0 if each.slew is None else 1.0 / each.slew] for each in both
    ]
    damping = [[mode.damping for mode in each.modes] for each in both]
    lags = np.allclose(*times, rtol=NEAR_LAG, atol=0.0)
    return lags and np.allclose(*damping, rtol=NEAR_DAMPING)


def _best(fit: Optimum, records: Sequence[Record]) -> LinearDynamics:
    """Return the dynamics with the most modes; if equal, those of the first record.

    The slew rate is that of the first record with steps that show one.
    """
    system = fit.system
    assert isinstance(system, Series)
    place = next(i for i, name in enumerate(system.names) if name in LINEAR)
    parts = dict(zip(system.names[:place], system.parts[:place], strict=True))
    amplifier, hysteresis = parts.pop(DRIVE, None), series(**parts)
    found = []
    for record, levels in zip(records, fit.starts.levels, strict=True):

        def front_of(
            input: np.ndarray, front: System = hysteresis, levels: Array = levels
        ) -> np.ndarray:
            run = np.asarray(run_after(front, jnp.asarray(input), levels))
            # A plant maps u(k) to y(k+1): the delay belongs to the dynamics.
            return np.append(run[1:], run[-1])

        slew = slew_behind(front_of, record.input, record.output, record.dt)
        if slew is not None:
            front = front_of(slewed(record.input, slew * record.dt))
        elif amplifier is not None:
            front = front_of(record.input, series(drive=amplifier, **parts))
        else:
            front = front_of(record.input)
        shown = dynamics_behind(front, record.output, record.dt)
        found.append(shown._replace(slew=slew))
    best = max(found, key=lambda each: len(each.modes))
    slews = (each.slew for each in found if each.slew is not None)
    return best._replace(slew=next(slews, None))
