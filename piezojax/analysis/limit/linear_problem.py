"""Linear control problem of a loop's runs: a plant, a disturbance and a noise."""

from typing import NamedTuple

import jax
import numpy as np

from ...core.feedback import Feedback, LoopSample
from .linear_plant import LinearPlant, gain_from_noise, linear_plant, plant_response
from .spectra import ReferencePredictor, grid_size, spectra, windowed


class LinearProblem(NamedTuple):
    """Linear control problem, and the lengths of its windows and spectra.

    ``plant`` is the linear model of the stage, and ``residual`` [references, draws,
    samples] the disturbance (um): the displacement of the runs minus the response of
    that model. ``predictor`` is the linear filter that predicts the disturbance from
    the reference, ``spectra`` [references, points] (um^2) are those of the unpredicted
    part, and ``variance`` (um^2) is that of the sensor's noise. ``window`` is in
    samples.
    """

    plant: LinearPlant
    residual: np.ndarray
    predictor: ReferencePredictor
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
) -> LinearProblem:
    """Return the linear problem of ``runs`` [references x draws, samples].

    ``rest`` [references x draws] are the voltages (V) before the runs; other arguments
    as for ``performance_limit``.

    Raises ValueError for a run that diverges, a sensor with dynamics or without noise,
    several axes, and a plant that is unstable or does not move as its linear model
    does.
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
    predictor = ReferencePredictor(references, start, reach)
    window = min(round(segment / dt), predictor.count)
    points = grid_size(window)

    def by_draw(signals: np.ndarray) -> np.ndarray:
        return signals.reshape(count, -1, samples)

    def lines(signals: np.ndarray) -> np.ndarray:
        return windowed(signals, window, points)

    plant = linear_plant(loop, 0.5 * (references.min() + references.max()), dt)
    if jax.tree.leaves(loop.sensor.init((0.0, 0.0))):
        raise ValueError(
            "the limit is known for a sensor without bandwidth, delay and filter"
        )
    response = plant_response(plant, runs.voltage, rest)
    gain = gain_from_noise(
        lines(predictor.unpredicted(by_draw(response))),
        lines(predictor.unpredicted(by_draw(runs.displacement))),
        lines(predictor.centred(by_draw(sensor_noise))),
    )
    # The residual of the linear plant is 0 at the start, at rest.
    residual = by_draw(runs.displacement - runs.displacement[:, :1] - gain * response)
    found = spectra(lines(predictor.unpredicted(residual)))
    return LinearProblem(
        plant.scaled(gain), residual, predictor, found, variance, window
    )
