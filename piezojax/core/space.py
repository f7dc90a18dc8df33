"""Search box of tuning and identification: paths, bounds and scales of parameters."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .arrays import as_array
from .parameter import Parameter, Scale, rounded
from .paths import get, replace
from .system import System

S = TypeVar("S", bound=System)

SCALES: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "linear": (lambda x: x, lambda x: x),
    "log": (jnp.log, jnp.exp),
    "logit": (lambda x: jnp.log(x) - jnp.log1p(-x), jax.nn.sigmoid),
}
"""Map and inverse map of each scale: ``log`` for positive values that span decades,
``logit`` for values between 0 and 1."""

INSIDE = 1e-6
"""Least distance of a start from a bound, as a share of the box. On the bound itself
the smooth map to the real line has no slope."""


@dataclass(frozen=True)
class Range:
    """Bounds of a parameter in its ``unit``, and the scale on which it is searched.

    ``start`` is the starting value of a search; None keeps the value in the System.
    Values are rounded to multiples of ``step``, the resolution of a device.
    """

    lower: float
    upper: float
    scale: Scale = "linear"
    start: float | None = None
    unit: str = ""
    step: float | None = None

    @classmethod
    def of(cls, declared: Parameter) -> "Range | None":
        """Return the typical Range of a declared parameter, or None if it has none."""
        if declared.typical is None:
            return None
        lower, upper = declared.typical
        return cls(
            lower, upper, declared.scale, unit=declared.unit, step=declared.step
        ).limited(declared)

    def limited(self, declared: Parameter | None) -> "Range":
        """Return the Range with its bounds inside the limits of a declared parameter.

        Its upper end is at least 1 % below an exclusive upper limit.
        """
        if declared is None:
            return self
        lower = max(self.lower, declared.least)
        upper = min(self.upper, declared.most, 0.99 * declared.below)
        return dataclasses.replace(self, lower=lower, upper=upper)

    def inside(self) -> "Range":
        """Return the Range with its bounds moved inside, to multiples of the step."""
        if self.step is None:
            return self
        slack = 1e-9  # a bound on the grid stays, despite rounding errors
        lower = self.step * math.ceil(self.lower / self.step - slack)
        upper = self.step * math.floor(self.upper / self.step + slack)
        return dataclasses.replace(self, lower=lower, upper=upper)

    def check(self, name: str) -> None:
        """Raise ValueError unless the bounds are in order and suit the scale."""
        low, high = self.lower, self.upper
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise ValueError(
                f"{name}: bounds are {low:g} and {high:g}; "
                "they must be finite and the lower below the upper"
            )
        if self.scale == "log" and low <= 0:
            raise ValueError(
                f"{name}: the lower bound is {low:g}; "
                "with scale 'log' it must be above 0"
            )
        if self.scale == "logit" and (low <= 0 or high >= 1):
            raise ValueError(
                f"{name}: the bounds are {low:g} and {high:g}; "
                "with scale 'logit' they must lie between 0 and 1"
            )


class Space(eqx.Module):
    """A box of parameters, each mapped through its scale onto [0, 1].

    ``space_of`` builds it from Ranges. The bounds are arrays, so that a program
    compiled for one Space serves other bounds of the same parameters too.
    """

    paths: tuple[str, ...] = eqx.field(static=True)
    scales: tuple[Scale, ...] = eqx.field(static=True)
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    steps: tuple[float | None, ...] = eqx.field(static=True)

    def ranges(self) -> dict[str, Range]:
        """Return the Range of each parameter by path."""
        lower, upper = np.asarray(self.lower).tolist(), np.asarray(self.upper).tolist()
        rows = zip(lower, upper, self.scales, self.steps, strict=True)
        ranges = [Range(low, high, scale, step=step) for low, high, scale, step in rows]
        return dict(zip(self.paths, ranges, strict=True))

    def start(self, system: System) -> Float[Array, " n"]:
        """Return the parameters of ``system`` as a point of [0, 1]^n.

        A parameter on a bound is moved inside by ``INSIDE``. Raises ValueError for a
        parameter outside its bounds.
        """
        bounds = np.asarray(self.lower), np.asarray(self.upper)
        values = self._values(system)
        for path, value, low, high in zip(self.paths, values, *bounds, strict=True):
            if not low <= value <= high:
                raise ValueError(
                    f"{path} starts at {value:g}; its bounds {low:g} to {high:g} must "
                    "include the start: set the start or the bounds in the study"
                )
        return as_array(self.nearest(system))

    def nearest(self, system: System) -> np.ndarray:
        """Return the parameters of ``system`` as a point [n] inside the unit box.

        A parameter on a bound or beyond it is moved inside by ``INSIDE``.
        """
        unit = np.asarray(self.to_unit(self._values(system)))
        return np.clip(unit, INSIDE, 1.0 - INSIDE)

    def _values(self, system: System) -> np.ndarray:
        return np.asarray([get(system, path) for path in self.paths], float)

    def _map(self, values: Array, direction: int) -> Array:
        mapped = [
            SCALES[name][direction](value)
            for name, value in zip(self.scales, values, strict=True)
        ]
        return as_array(mapped)

    @jax.jit
    def to_unit(self, values: Float[Array, " n"]) -> Float[Array, " n"]:
        """Map parameter values into [0, 1]^n."""
        low, high = self._map(self.lower, 0), self._map(self.upper, 0)
        return (self._map(values, 0) - low) / (high - low)

    @jax.jit
    def from_unit(self, unit: Float[Array, " n"]) -> Float[Array, " n"]:
        """Map [0, 1]^n to parameter values, never outside the bounds.

        Values with a step are rounded to it; the derivatives ignore that.
        """
        low, high = self._map(self.lower, 0), self._map(self.upper, 0)
        values = self._map(low + unit * (high - low), 1)
        # exp(log(x)) may differ from x by a rounding error.
        values = jnp.clip(values, self.lower, self.upper)
        if not any(self.steps):
            return values
        pairs = zip(values, self.steps, strict=True)
        return jnp.stack([rounded(value, step) for value, step in pairs])

    def put(self, system: S, unit: Float[Array, " n"]) -> S:
        """Return ``system`` with its tuned parameters at ``unit``."""
        return replace(system, self.named(unit))

    @jax.jit
    def named(self, unit: Float[Array, " n"]) -> dict[str, Array]:
        """Return the parameter values at ``unit`` by path."""
        return dict(zip(self.paths, self.from_unit(unit), strict=True))


def space_of(ranges: Mapping[str, Range]) -> Space:
    """Return the Space with the given Ranges by path.

    Bounds of a parameter with a step are moved inside, to multiples of it. Raises
    ValueError, naming the path, for bounds that are not in order or do not suit their
    scale.
    """
    ranges = {path: bounds.inside() for path, bounds in ranges.items()}
    for path, bounds in ranges.items():
        bounds.check(path)
    return Space(
        paths=tuple(ranges),
        scales=tuple(bounds.scale for bounds in ranges.values()),
        lower=as_array(np.array([bounds.lower for bounds in ranges.values()], float)),
        upper=as_array(np.array([bounds.upper for bounds in ranges.values()], float)),
        steps=tuple(bounds.step for bounds in ranges.values()),
    )


def squash(free: Array) -> Array:
    """Map the real line into (0, 1), for optimisers without bounds."""
    return jax.nn.sigmoid(free)


@jax.jit
def unsquash(unit: Array) -> Array:
    """Map (0, 1) onto the real line, the inverse of ``squash``."""
    return jnp.log(unit) - jnp.log1p(-unit)
