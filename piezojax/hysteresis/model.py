"""Interface of hysteresis models, and the laws that they obey."""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, TypeAlias

import jax

from ..core.arrays import ScalarLike
from ..core.system import System
from .inverse import Inverse

Laws: TypeAlias = Mapping[str, float]
"""Laws that a model obeys, each with its largest deviation.

The deviation is a share of the output's span; that of "counter-clockwise", an area, is
a share of the product of the spans of output and input.
"""

EXACT = 1e-9
"""Largest deviation from a law that holds up to rounding."""

STEP = 5e-3
"""Largest deviation from a law that holds only up to the error of the integration, at
16 samples per branch."""

LAWS: Laws = {
    "return-point memory": EXACT,
    "wiping-out": EXACT,
    "congruency": EXACT,
    "rate independence": EXACT,
    "pauses": EXACT,
    "counter-clockwise": STEP,
}
"""All laws, in this order: minor loops close; larger extrema wipe out those between
them; minor loops between the same two inputs have the same shape; the speed of the
input has no effect; pauses have no effect; loops run counter-clockwise, as for a piezo.
"""


def turning_point_laws(*, without: tuple[str, ...] = ()) -> Laws:
    """Return the laws of a model that remembers extrema, except ``without``."""
    return {law: share for law, share in LAWS.items() if law not in without}


def differential_laws(*, without: tuple[str, ...] = ()) -> Laws:
    """Return the laws of a differential model, whose memory fades with the path."""
    kept = {"rate independence": STEP, "pauses": EXACT, "counter-clockwise": STEP}
    return {law: share for law, share in kept.items() if law not in without}


class Hysteresis(System):
    """A System whose output depends on the turning points of its past input.

    Input in V and output in um, unless the model says otherwise.

    ``laws`` are the laws that the model obeys with the parameters of a piezo, such as
    the starting values of its recipe.

    ``dynamic`` is True if the output can change while the input rests: the model
    contains dynamics that cannot be separated from the hysteresis, and needs no lag
    after it.
    """

    dynamic: ClassVar[bool] = False
    laws: ClassVar[Laws] = {}

    @abc.abstractmethod
    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        """Return the inverse for inputs from ``lower`` to ``upper`` (V).

        The inverse is a closed form if there is one, else InverseHysteresis. Raises
        ValueError with the reason if no inverse exists, such as an output that falls
        while the input rises.
        """


def hystereses(system: Any) -> list[Hysteresis]:
    """Return every hysteresis model in the tree of ``system``, in order."""

    def is_hysteresis(part: Any) -> bool:
        return isinstance(part, Hysteresis)

    parts = jax.tree.leaves(system, is_leaf=is_hysteresis)
    return [part for part in parts if is_hysteresis(part)]
