"""The interface of every hysteresis model."""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, TypeAlias

import jax

from ..core.arrays import Scalar, ScalarLike
from ..core.system import System
from .inverse import Inverse

Laws: TypeAlias = Mapping[str, float]
"""Laws that a model keeps, and the share of the output's span to which it does."""

EXACT = 1e-9
"""Defect of a law that is kept to rounding."""

STEP = 5e-3
"""Defect of a law that is kept to the order of the step, at 16 samples a branch."""

LAWS: Laws = {
    "return-point memory": EXACT,
    "wiping-out": EXACT,
    "congruency": EXACT,
    "rate independence": EXACT,
    "pauses": EXACT,
    "counter-clockwise": STEP,
}
"""Every law. Minor loops close, larger extrema wipe out those between them, minor loops
of one range have one shape, speed and pauses do not matter, loops turn like a piezo's.
"""


def remembers(*, but: tuple[str, ...] = ()) -> Laws:
    """Return the laws of a model that remembers extrema, without those in ``but``."""
    return {law: share for law, share in LAWS.items() if law not in but}


def fades(*, but: tuple[str, ...] = ()) -> Laws:
    """Return the laws of a differential model, whose memory fades with the path."""
    kept = {"rate independence": STEP, "pauses": EXACT, "counter-clockwise": STEP}
    return {law: share for law, share in kept.items() if law not in but}


class Hysteresis(System):
    """A System whose output depends on the turning points of its past input.

    Input in V and output in um, unless the model says otherwise.

    ``before`` names the field that holds the input in force before a record begins, if
    the model has one; a free run then starts at rest under that input, otherwise at
    rest under the record's first input. ``laws`` are those that the model keeps with
    the parameters of a piezo, such as its recipe starts from.

    ``dynamic`` says that the output may go on while the input rests: the model holds
    dynamics that cannot be separated from the hysteresis, and needs no lag behind it.
    """

    before: ClassVar[str | None] = None
    dynamic: ClassVar[bool] = False
    laws: ClassVar[Laws] = {}

    @abc.abstractmethod
    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        """Return the inverse for inputs from ``lower`` to ``upper`` (V).

        A closed form where there is one, InverseHysteresis otherwise. Raises ValueError
        with the reason where no inverse exists, such as an output that falls while the
        input rises.
        """


def hystereses(system: Any) -> list[Hysteresis]:
    """Return every hysteresis model in the tree of ``system``, first to last."""

    def is_hysteresis(part: Any) -> bool:
        return isinstance(part, Hysteresis)

    parts = jax.tree.leaves(system, is_leaf=is_hysteresis)
    return [part for part in parts if is_hysteresis(part)]


def input_before(system: Any, otherwise: ScalarLike) -> Scalar | ScalarLike:
    """Return the input (V) in force before a record, as ``system`` holds it.

    ``otherwise`` is returned for a system without such a memory.
    """
    for model in hystereses(system):
        if model.before is not None:
            return getattr(model, model.before)
    return otherwise
