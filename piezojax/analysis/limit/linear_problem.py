"""Linear control problem of a loop's runs: a plant, a disturbance and a noise."""

from typing import NamedTuple

import numpy as np

from ...core.system import Feedback, LoopSample
from .linear_plant import LinearPlant, answers, felt_gain, linear_plant
from .spectra import Foretelling, grid_size, spectra, windowed


class Problem(NamedTuple):
    """Linear control problem, and the grids on which it was measured.

    ``plant`` is the linear model of the stage, and ``left`` [references, draws,
    samples] its residual in the runs (um), the disturbance. ``known`` is the linear
    filter that predicts the disturbance from the reference, ``spectra`` [references,
    points] (um^2) are those of the unpredicted part, and ``variance`` (um^2) is that of
    the sensor's noise. ``window`` is in samples.
    """

    plant: LinearPlant
    left: np.ndarray
    known: Foretelling
    spectra: np.ndarray
    variance: float
    window: int

    @property
    def points(self) -> int:
        """Number of points of spectra and responses around the unit circle."""
        return self.spectra.shape[1]

    def lines(self, signals: np.ndarray) -> np.ndarray:
        """Return the transforms of ``signals`` [..., count] in each window."""
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
    """Return the linear problem of ``runs`` [references x draws, samples].

    ``rest`` [references x draws] are the voltages (V) before the runs; other arguments
    as for ``performance_limit``.

    Raises ValueError for a run that diverges, a sensor without noise, several axes, and
    a plant that is unstable or does not move as its linear model does.
    """
    sensor_noise = runs.measured - runs.displacement
    if not np.all(np.isfinite(runs.displacement)):
        raise ValueError("a run diverges")
    variance = float(np.var(sensor_noise[:, start:]))
    if variance == 0.0:
        raise ValueError("without sensor noise the limit of linear control is zero")
    count, samples = references.shape
    # The filter is as long as a window, so that both use an equal length of record.
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
        lines(known.cut(by_draw(sensor_noise))),
    )
    # The residual of the linear plant is 0 at the start, at rest.
    left = by_draw(runs.displacement - runs.displacement[:, :1] - gain * answer)
    found = spectra(lines(known.unforeseen(left)))
    return Problem(plant.scaled(gain), left, known, found, variance, window)
