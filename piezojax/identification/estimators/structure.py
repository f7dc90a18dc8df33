"""Structure: the input of estimators that search a box of parameters."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from ...core.recipe import LinearWeights
from ...core.space import Range, Space, space_of
from ...core.system import Series, System, series
from .approach import BEFORE, Before


class Prior(NamedTuple):
    """Normal prior of the parameters of a structure, in the unit box.

    ``known`` [n] are the most likely values, ``deviations`` [n] the standard deviations
    of the parameters, infinite for one that the prior does not hold. ``scale`` (unit of
    the output) is the rms of the errors over the root of the number of independent
    ones; 0 switches the prior off.
    """

    known: np.ndarray
    deviations: np.ndarray
    scale: float

    @property
    def weights(self) -> np.ndarray:
        """Factors [n] of the differences from ``known`` (unit of the output).

        The squares of the products add to the mean square error.
        """
        return self.scale / self.deviations


def distinct(starts: np.ndarray) -> np.ndarray:
    """Return the different ones of ``starts`` [starts, n], in their order."""
    return starts[np.sort(np.unique(starts, axis=0, return_index=True)[1])]


class Structure(NamedTuple):
    """A model to fit: its System, the box of its parameters, starts in the box.

    ``own`` holds the paths of the state before a record and of the sensor's zero, which
    differ from record to record. ``dynamics`` holds the paths of linear dynamics,
    ``slow`` those of creep, which a short record does not determine, and ``vague``
    those of the terms of a sum, each with its typical distance from the first guess, as
    in Recipe, but in the unit box.
    ``whitening`` holds the coefficients of a filter that turns the errors into white
    noise; if it has any, the filtered errors count as much as the errors themselves,
    which are largest at low frequencies. ``prior`` is that of the parameters, if any.
    ``weights`` are those of the errors of each record, by default equal. ``guess`` [n]
    is the first guess of the vague parameters in the unit box, if no start has it.
    ``linear`` are weights outside the box, as in Recipe.
    """

    system: System
    space: Space
    starts: np.ndarray
    own: tuple[str, ...] = ()
    dynamics: tuple[str, ...] = ()
    slow: tuple[str, ...] = ()
    vague: Mapping[str, float] = {}
    whitening: tuple[float, ...] = ()
    prior: Prior | None = None
    weights: tuple[float, ...] = ()
    guess: np.ndarray | None = None
    linear: LinearWeights | None = None

    def weight(self, record: int) -> float:
        """Return the weight of the errors of a record."""
        return self.weights[record] if self.weights else 1.0

    @property
    def order(self) -> int:
        """Number of parameters of linear dynamics."""
        return len(self.dynamics)

    def with_before(self, input: np.ndarray) -> "Structure":
        """Return the structure of a chain with the input before a record to fit.

        It starts at the first ``input`` [samples] of the record, and lies at most half
        a range from the inputs of the record, or from 0 V. Other Systems, such as whole
        loops, have none.
        """
        system, low, high = self.system, float(input.min()), float(input.max())
        if not isinstance(system, Series) or BEFORE in self.space.paths:
            return self
        parts = dict(zip(system.names, system.parts, strict=True))
        margin = 0.5 * (high - low)
        bounds = Range(min(low, 0.0) - margin, max(high, 0.0) + margin)
        share = (input[0] - bounds.lower) / (bounds.upper - bounds.lower)
        return self._replace(
            system=series(before=Before(input[0]), **parts),
            space=space_of({BEFORE: bounds, **self.space.ranges()}),
            starts=np.insert(self.starts, 0, share, axis=1),
            own=(BEFORE, *self.own),
        )

    def without(self, paths: Collection[str]) -> "Structure":
        """Return the structure with the parameters at ``paths`` fixed."""
        ranges = self.space.ranges()
        kept = {path: bounds for path, bounds in ranges.items() if path not in paths}
        columns = [path in kept for path in ranges]
        prior = self.prior
        if prior is not None:
            own = prior.known[columns], prior.deviations[columns]
            prior = Prior(*own, prior.scale)
        # Starts that differed only in the fixed parameters are one.
        starts = distinct(self.starts[:, columns])
        guess = None if self.guess is None else self.guess[columns]
        return self._replace(
            space=space_of(kept), starts=starts, prior=prior, guess=guess
        )
