"""The interface of every hysteresis model."""

import abc
from typing import Any, ClassVar

import jax

from ..core.arrays import Scalar, ScalarLike
from ..core.system import System
from .inverse import Inverse


class Hysteresis(System):
    """A System whose output depends on the turning points of its past input.

    Input in V and output in um, unless the model says otherwise.

    ``before`` names the field that holds the input in force before a record begins, if
    the model has one; a free run then starts at rest under that input, otherwise at
    rest under the record's first input.

    ``dynamic`` says that the output may go on while the input rests: the model holds
    dynamics that cannot be separated from the hysteresis.
    """

    before: ClassVar[str | None] = None
    dynamic: ClassVar[bool] = False

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
