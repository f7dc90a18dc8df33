"""From a loop's runs to the linear problem: a plant, a disturbance and a noise."""

from typing import NamedTuple

import numpy as np

from ...core.system import Feedback, LoopSample
from .linear_plant import LinearPlant, answers, felt_gain, linear_plant
from .spectra import Foretelling, grid_size, spectra, windowed


class Problem(NamedTuple):
    """What a linear controller meets, and the grids that it was measured on.

    ``plant`` is the stage's linear model, ``left`` [references, draws, samples] what it
    leaves of the runs (um), ``spectra`` [references, points] those of the part that
    ``known``, the filter of the reference, does not foretell; ``variance`` (um^2) that
    of the sensor's noise. ``window`` is in samples.
    """

    plant: LinearPlant
    left: np.ndarray
    known: Foretelling
    spectra: np.ndarray
    variance: float
    window: int

    @property
    def points(self) -> int:
        """Points of the circle on which spectra and responses lie."""
        return self.spectra.shape[1]

    def lines(self, signals: np.ndarray) -> np.ndarray:
        """Return the transforms of ``signals`` [..., count], window by window."""
        return windowed(signals, self.window, self.points)


def problem_of(
    loop: Feedback,
    runs: LoopSample,
    rest: np.ndarray,
    references: np.ndarray,
    start: int,
    segment: float,
    dt: float,
) -> Problem:
    """Return the problem that ``runs`` [references x draws, samples] pose.

    ``rest`` [references x draws] are the voltages before them; other arguments as for
    ``performance_limit``, which see for what is raised.
    """
    heard = runs.measured - runs.displacement
    if not np.all(np.isfinite(runs.displacement)):
        raise ValueError("a run diverges")
    variance = float(np.var(heard[:, start:]))
    if variance == 0.0:
        raise ValueError("without sensor noise the limit of linear control is zero")
    count, samples = references.shape
    # The filter is as long as a window: both hold as much of the past.
    reach = min(round(0.5 * segment / dt), (samples - start) // 8)
    known = Foretelling(references, start, reach)
    window = min(round(segment / dt), known.count)
    points = grid_size(window)

    def by_draw(signals: np.ndarray) -> np.ndarray:
        return signals.reshape(count, -1, samples)

    def lines(signals: np.ndarray) -> np.ndarray:
        return windowed(signals, window, points)

    plant = linear_plant(loop, 0.5 * (references.min() + references.max()), dt)
    answer = answers(plant, runs.voltage, rest)
    gain = felt_gain(
        lines(known.unforeseen(by_draw(answer))),
        lines(known.unforeseen(by_draw(runs.displacement))),
        lines(known.cut(by_draw(heard))),
    )
    # At rest, where it started, the linear plant leaves nothing.
    left = by_draw(runs.displacement - runs.displacement[:, :1] - gain * answer)
    found = spectra(lines(known.unforeseen(left)))
    return Problem(plant.scaled(gain), left, known, found, variance, window)
