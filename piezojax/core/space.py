"""The box that tuning and identification search: paths, bounds, scales."""

from collections.abc import Callable, Mapping
from typing import Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .arrays import as_array
from .paths import get, replace
from .system import System

S = TypeVar("S", bound=System)

Transform = Literal["log", "logit", "linear"]

TRANSFORMS: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "linear": (lambda x: x, lambda x: x),
    "log": (jnp.log, jnp.exp),
    "logit": (lambda x: jnp.log(x) - jnp.log1p(-x), jax.nn.sigmoid),
}
"""Scales by name, forth and back: ``log`` for what is positive and spans decades,
``logit`` for what lies between 0 and 1."""

INSIDE = 1e-6
"""How far inside its box, as a share of its side, a start on a bound is moved: the
smooth map to the whole line has no slope on the bound itself."""


class Space(eqx.Module):
    """A box of parameters, each seen through its transform and scaled to [0, 1]."""

    paths: tuple[str, ...] = eqx.field(static=True)
    transforms: tuple[str, ...] = eqx.field(static=True)
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    def __check_init__(self):
        for i, path in enumerate(self.paths):
            low, high = float(self.lower[i]), float(self.upper[i])
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise ValueError(
                    f"{path}: bounds are {low:g} and {high:g}; "
                    "they must be finite and the lower below the upper"
                )
            if self.transforms[i] == "log" and low <= 0:
                raise ValueError(
                    f"{path}: the lower bound is {low:g}; "
                    "with transform 'log' it must be above 0"
                )
            if self.transforms[i] == "logit" and (low <= 0 or high >= 1):
                raise ValueError(
                    f"{path}: the bounds are {low:g} and {high:g}; "
                    "with transform 'logit' they must lie between 0 and 1"
                )

    def start(self, system: System) -> Float[Array, " n"]:
        """Return where ``system`` lies in the box.

        Raises ValueError for a parameter outside its bounds.
        """
        values = jnp.stack([as_array(get(system, path)) for path in self.paths])
        for path, value, low, high in zip(
            self.paths, values, self.lower, self.upper, strict=True
        ):
            if not low <= value <= high:
                raise ValueError(
                    f"{path} starts at {float(value):g}; its bounds "
                    f"{float(low):g} to {float(high):g} must include the start"
                )
        return jnp.clip(self.to_unit(values), INSIDE, 1.0 - INSIDE)

    def _map(self, values: Array, direction: int) -> Array:
        mapped = [
            TRANSFORMS[name][direction](value)
            for name, value in zip(self.transforms, values, strict=True)
        ]
        return jnp.stack(mapped)

    def to_unit(self, values: Float[Array, " n"]) -> Float[Array, " n"]:
        """Map parameter values into [0, 1]^n."""
        low, high = self._map(self.lower, 0), self._map(self.upper, 0)
        return (self._map(values, 0) - low) / (high - low)

    def from_unit(self, unit: Float[Array, " n"]) -> Float[Array, " n"]:
        """Map [0, 1]^n to parameter values, never outside the bounds."""
        low, high = self._map(self.lower, 0), self._map(self.upper, 0)
        values = self._map(low + unit * (high - low), 1)
        # exp(log(x)) may miss x by a rounding.
        return jnp.clip(values, self.lower, self.upper)

    def put(self, system: S, unit: Float[Array, " n"]) -> S:
        """Return ``system`` with its tuned parameters at ``unit``."""
        return replace(system, self.named(unit))

    def named(self, unit: Float[Array, " n"]) -> dict[str, Array]:
        """Return the parameter values at ``unit`` by path."""
        return dict(zip(self.paths, self.from_unit(unit), strict=True))


def space_of(
    bounds: Mapping[str, tuple[float, float, Transform]],
) -> Space:
    """Return the Space of ``{path: (lower, upper, transform)}``."""
    return Space(
        paths=tuple(bounds),
        transforms=tuple(transform for _, _, transform in bounds.values()),
        lower=as_array([low for low, _, _ in bounds.values()]),
        upper=as_array([high for _, high, _ in bounds.values()]),
    )


def squash(free: Array) -> Array:
    """Map the whole line into (0, 1), for optimisers that know no bounds."""
    return jax.nn.sigmoid(free)


def unsquash(unit: Array) -> Array:
    """Undo ``squash``."""
    return jnp.log(unit) - jnp.log1p(-unit)
