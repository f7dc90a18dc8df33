"""What tuned gains must keep: limits with a meaning, measured and pulled in."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..analysis.stability.impulse import (
    Sensitivity,
    delay_margin_of,
    disk_margin_of,
    peak_of,
)
from ..core.metrics import ExtremeFigures, TrackingFigures

CAP = 3.0
"""Logarithm of value over limit beyond which a violation grows slowly: the loop is
unstable then, and how much so has no meaning."""


class Seen(NamedTuple):
    """What constraints look at.

    Figures of every plant, reference and draw; ``sensitivity`` S of every plant on
    which margins are kept, and branch. ``extremes`` and ``sensitivity`` are None unless
    a limit needs them. ``dt`` in s.
    """

    figures: TrackingFigures
    extremes: ExtremeFigures | None
    sensitivity: Sensitivity | None
    dt: float


Need = Literal["figures", "extremes", "sensitivity"]


class Constraint(NamedTuple):
    """A limit: what it bounds, in which unit and direction, and how it is read off.

    ``values`` is given the part of what is seen that it ``needs``, and dt, and returns
    values with the plants on the first axis.
    """

    unit: str
    sense: Literal["at most", "at least"]
    needs: Need
    values: Callable[[Any, float], Array]

    def read(self, seen: Seen) -> Array:
        """Return the values in the unit, of shape [plants] or [plants, branches]."""
        return self.values(getattr(seen, self.needs), seen.dt)


def _largest(runs: Array) -> Array:
    """Return the largest of the runs of each plant."""
    return jnp.max(runs, axis=(1, 2))


def _margin(figure: Callable[[Array], Array]) -> Callable[[Array, float], Array]:
    return lambda sensitivity, dt: jax.vmap(jax.vmap(figure))(sensitivity)


CONSTRAINTS: dict[str, Constraint] = {
    "sensitivity_peak": Constraint("1", "at most", "sensitivity", _margin(peak_of)),
    "disk_margin": Constraint("1", "at least", "sensitivity", _margin(disk_margin_of)),
    "delay_margin": Constraint(
        "samples", "at least", "sensitivity", _margin(delay_margin_of)
    ),
    "peak_voltage": Constraint(
        "V", "at most", "figures", lambda figures, dt: _largest(figures.peak_voltage)
    ),
    "peak_slew": Constraint(
        "V/s", "at most", "extremes", lambda found, dt: _largest(found.peak_slew) / dt
    ),
    "effort": Constraint(
        "V rms", "at most", "figures", lambda figures, dt: _largest(figures.rms_effort)
    ),
    "overshoot": Constraint(
        "1", "at most", "extremes", lambda found, dt: _largest(found.overshoot)
    ),
}
"""Constraints by the name a study uses."""


def needs(names: Iterable[str], what: Need) -> bool:
    """Return whether one of the constraints ``names`` needs ``what``."""
    return any(CONSTRAINTS[name].needs == what for name in names)


def violations(
    limits: Mapping[str, Array | float], seen: Seen
) -> Float[Array, " constraints"]:
    """Return ln(value/limit), or its negative, of all limits: above 0 is violated.

    One for each plant and branch, in the order of ``limits``; an infinite or undefined
    value counts as badly violated.
    """
    found = []
    for name, limit in limits.items():
        kind = CONSTRAINTS[name]
        sign = 1.0 if kind.sense == "at most" else -1.0
        value = jnp.maximum(kind.read(seen).ravel(), 1e-12)
        by = sign * (jnp.log(value) - jnp.log(limit))
        by = jnp.where(jnp.isfinite(by), by, 100.0 * CAP)
        far = by > CAP
        slow = CAP * (1.0 + jnp.log(jnp.where(far, by, CAP) / CAP))
        found.append(jnp.where(far, slow, by))
    return jnp.concatenate(found) if found else jnp.zeros(0)


def by_stage(limits: Iterable[str], seen: Seen) -> dict[str, Array]:
    """Return the value of each stage nearest to, or farthest beyond, each limit."""
    pick = {"at most": jnp.max, "at least": jnp.min}
    found = {}
    for name in limits:
        values = CONSTRAINTS[name].read(seen)
        values = values.reshape(values.shape[0], -1)
        found[name] = pick[CONSTRAINTS[name].sense](values, axis=1)
    return found
