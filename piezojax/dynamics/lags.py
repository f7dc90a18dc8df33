"""First-order lags of a plant, and the inverse of such a lag."""

from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Float

from ..core.arrays import Scalars


@runtime_checkable
class Lagging(Protocol):
    """Part of a plant whose output lags: ``lags`` are first-order time constants, s."""

    @property
    def lags(self) -> Scalars: ...


def lags_of(system: Any) -> list[float]:
    """Return the time constants (s) of all parts of ``system`` that lag."""

    def lagging(part: Any) -> bool:
        return isinstance(part, Lagging)

    parts = jax.tree.leaves(system, is_leaf=lagging)
    return [float(lag) for part in parts if lagging(part) for lag in part.lags]


def before_lag(
    output: Float[np.ndarray, "*batch samples"], time_constant: float, dt: float
) -> Float[np.ndarray, "*batch samples-1"]:
    """Return the input of a first-order lag from its ``output``, one sample shorter.

    This inverts ``FirstOrderLag``, whose input is held between samples of ``dt`` s.
    """
    pole = np.exp(-dt / time_constant)
    return (output[..., 1:] - pole * output[..., :-1]) / (1.0 - pole)
