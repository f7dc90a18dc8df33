"""What an observer is to a controller: displacement and velocity from what is seen."""

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx

from ..core.arrays import Scalar
from ..core.system import System


class Motion(NamedTuple):
    """Displacement in um and velocity in um/s."""

    position: Scalar
    velocity: Scalar


class Observer(System):
    """A System from an Observation to a Motion, every ``dt`` seconds.

    It sees all that its controller sees: one that needs the measurement only looks at
    nothing else, one with a model uses ``applied``, in the unit of the model's input.
    """

    if TYPE_CHECKING:  # else a checker takes it for the first field of each observer

        @property
        def dt(self) -> float: ...

    else:
        dt: eqx.AbstractVar[float]
