"""Structure: the input of estimators that search a box of parameters."""

from typing import NamedTuple

import numpy as np

from ...core.space import Space
from ...core.system import System


class Structure(NamedTuple):
    """A model to fit: its System, the box of its parameters, starts in the box.

    ``own`` holds the paths whose value differs from record to record. ``order`` is the
    number of parameters of linear dynamics.
    """

    system: System
    space: Space
    starts: np.ndarray
    own: tuple[str, ...] = ()
    order: int = 0
