"""Structure: the input of estimators that search a box of parameters."""

from typing import NamedTuple

import numpy as np

from ...core.space import Space
from ...core.system import System


class Structure(NamedTuple):
    """A model to fit: its System, the box of its parameters, starts in the box.

    ``own`` holds the paths whose value differs from record to record. ``dynamics``
    holds the paths of linear dynamics. ``whitening`` holds the coefficients of a
    filter that turns the errors into white noise; if it has any, the filtered errors
    count as much as the errors themselves, which are largest at low frequencies.
    """

    system: System
    space: Space
    starts: np.ndarray
    own: tuple[str, ...] = ()
    dynamics: tuple[str, ...] = ()
    whitening: tuple[float, ...] = ()

    @property
    def order(self) -> int:
        """Number of parameters of linear dynamics."""
        return len(self.dynamics)
