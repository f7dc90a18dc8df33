"""Measured frequency response of one input and one output, with its variances."""

import math
from dataclasses import dataclass, field

import numpy as np

LEAST_LINES = 8


@dataclass(frozen=True)
class FrequencyResponse:
    """Measured frequency response of one input and one output.

    ``frequency`` [lines] in Hz increases; ``values`` [lines] are complex, in ``unit``
    (output over input).

    ``variance`` [lines] is the expected square of the modulus of the error of
    ``values``, None if it is not known, and ``freedom`` the number of real degrees of
    freedom from which it was estimated (infinite for a known variance). ``noise``
    [lines] is the part of the variance due to noise, None if it was not separated from
    nonlinear distortion. ``values`` are the mean of ``realisations`` responses.
    ``coherence`` [lines] is from 0 to 1. ``amplitude`` is the rms deviation of the
    input from its mean, None if it is not known. ``resolution`` (Hz) is the width of
    the band from which a line was estimated, 0 for a line by itself. ``held`` is the
    sample time (s) of the converters that held the input and sampled the output, None
    for an analogue analyser.

    Raises ValueError for fewer than LEAST_LINES lines, columns of different length,
    numbers that are not finite, frequencies that are not above 0 or do not increase,
    and variances below 0.
    """

    frequency: np.ndarray
    values: np.ndarray
    unit: str = "um/V"
    source: str = ""
    variance: np.ndarray | None = field(default=None, kw_only=True)
    noise: np.ndarray | None = field(default=None, kw_only=True)
    coherence: np.ndarray | None = field(default=None, kw_only=True)
    freedom: float = field(default=math.inf, kw_only=True)
    realisations: int = field(default=1, kw_only=True)
    amplitude: float | None = field(default=None, kw_only=True)
    resolution: float = field(default=0.0, kw_only=True)
    held: float | None = field(default=None, kw_only=True)

    def __post_init__(self):
        frequency = np.asarray(self.frequency, float)
        values = np.asarray(self.values, complex)
        object.__setattr__(self, "frequency", frequency)
        object.__setattr__(self, "values", values)
        where = f"{self.source}: " if self.source else ""
        if frequency.ndim != 1 or frequency.shape != values.shape:
            raise ValueError(
                f"{where}frequency has the shape {frequency.shape}, the response "
                f"{values.shape}; both must be [lines]"
            )
        if frequency.size < LEAST_LINES:
            raise ValueError(
                f"{where}the response has {frequency.size} lines; at least "
                f"{LEAST_LINES} are needed"
            )
        if not (np.all(np.isfinite(frequency)) and np.all(np.isfinite(values))):
            line = int(np.argmin(np.isfinite(frequency) & np.isfinite(values)))
            raise ValueError(f"{where}line {line} is not a finite number")
        if frequency[0] <= 0.0 or np.any(np.diff(frequency) <= 0.0):
            raise ValueError(
                f"{where}the frequencies must be above 0 and increase from line to line"
            )
        for name in ("variance", "noise", "coherence"):
            if getattr(self, name) is None:
                continue
            part = np.asarray(getattr(self, name), float)
            object.__setattr__(self, name, part)
            if part.shape != frequency.shape or not np.all(part >= 0.0):
                raise ValueError(
                    f"{where}the {name} must be a number of at least 0 for each line"
                )
        if not self.freedom > 0.0:
            raise ValueError(
                f"{where}the variance has {self.freedom:g} degrees of freedom; it must "
                "have more than 0"
            )

    @property
    def distortion(self) -> np.ndarray | None:
        """Variance [lines] of the nonlinear distortion of a realisation, or None.

        It is the excess of the total variance over that of the noise. This estimate is
        unbiased: it scatters around 0 where there is no distortion. Source: Pintelon
        and Schoukens, System Identification, 2nd ed., section 4.3.1.
        """
        if self.variance is None or self.noise is None:
            return None
        return self.realisations * (self.variance - self.noise)

    def band(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Return half the confidence bands [lines] of magnitude and phase (rad).

        The error is circular complex normal with the estimated variance, so the part
        along or across the response follows Student's t distribution. If the
        phase is not known, half its band is pi. Raises ValueError without a variance.
        """
        import scipy.stats  # takes long to import

        if self.variance is None:
            raise ValueError(f"{self.source}: the variance of the response is unknown")
        quantile = float(scipy.stats.t.ppf(0.5 + 0.5 * level, self.freedom))
        size = np.abs(self.values)
        magnitude = quantile * np.sqrt(0.5 * self.variance)
        share = magnitude / np.maximum(size, np.finfo(float).tiny)
        angle = np.arcsin(np.minimum(share, 1.0))
        return magnitude, np.where(share < 1.0, angle, np.pi)
