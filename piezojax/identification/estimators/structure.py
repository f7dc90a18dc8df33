"""A model to fit: what every estimator of parameters in a box works on."""

from typing import NamedTuple

import numpy as np

from ...core.space import Space
from ...core.system import System


class Structure(NamedTuple):
    """A model to fit: its System, the box of its parameters, starts in the box.

    ``own`` holds the paths of which every record has its own value, ``order`` counts
    the parameters of linear dynamics.
    """

    system: System
    space: Space
    starts: np.ndarray
    own: tuple[str, ...] = ()
    order: int = 0
