"""Observer protocol: displacement and velocity from an Observation."""

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx

from ..core.arrays import Scalar
from ..core.system import System


class Motion(NamedTuple):
    """Displacement in um and velocity in um/s."""

    position: Scalar
    velocity: Scalar


class Observer(System):
    """A System from an Observation to a Motion, with the sample time ``dt`` in s.

    It receives the Observation of its controller. A filter of the measurement uses only
    ``measured``; one with a model also uses ``applied``, in the unit of its input.
    """

    if TYPE_CHECKING:  # a type checker would count a field as a constructor argument

        @property
        def dt(self) -> float: ...

    else:
        dt: eqx.AbstractVar[float]
