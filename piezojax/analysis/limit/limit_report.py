"""Comparison of a loop with the linear-control limit, by reference."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

NEAR = 1.5
"""Largest ratio of an error to its limit that counts as near the limit."""


@dataclass(frozen=True)
class Shares:
    """Parts of an RMS error (um); their squares sum to the square of the error.

    ``noise`` is caused by the sensor's noise, and ``unpredicted`` by the part of the
    disturbance that the reference does not predict. ``predicted`` is the part that a
    linear filter of the reference predicts: the following error and the rest of the
    disturbance. Its square is the remainder of the total, 0 where the other two exceed
    the total.
    """

    noise: float
    unpredicted: float
    predicted: float = 0.0


@dataclass(frozen=True)
class LimitComparison:
    """Comparison of a loop with the limit on one reference; RMS figures in um.

    ``tuned`` is the error of the loop. ``limit`` is the least error of a linear
    controller designed for this reference, ``one_controller`` the error on this
    reference of the one controller with the least geometric-mean error over all
    references. ``disturbance`` is the whole disturbance, and ``unpredicted`` its part
    that the reference does not predict. ``bandwidth`` is the highest frequency (Hz) at
    which the spectrum of that part lies above that of the noise. ``tuned_shares`` is
    None if the loop is too nonlinear to split its error into shares.
    """

    tuned: float
    limit: float
    one_controller: float
    disturbance: float
    unpredicted: float
    bandwidth: float
    tuned_shares: Shares | None
    limit_shares: Shares

    @property
    def ratio(self) -> float:
        """Ratio of the loop's error to the limit; infinite if the limit is 0."""
        return self.tuned / self.limit if self.limit > 0.0 else float("inf")

    @property
    def largest_excess(self) -> str | None:
        """Name of the share whose mean square exceeds that of the limit most."""
        if self.tuned_shares is None:
            return None
        least = asdict(self.limit_shares)
        own = asdict(self.tuned_shares)
        return max(own, key=lambda name: own[name] ** 2 - least[name] ** 2)


@dataclass(frozen=True)
class Curves:
    """Spectra (um^2) against ``frequency`` [lines] (Hz); their means are variances.

    ``unpredicted`` [references, lines] is that of the unpredicted disturbance;
    ``noise`` is flat. ``tuned`` and ``limit`` [references, lines] are those of the
    errors.
    """

    frequency: np.ndarray
    unpredicted: np.ndarray
    noise: float
    tuned: np.ndarray
    limit: np.ndarray


@dataclass(frozen=True)
class LimitReport:
    """Comparison of a loop with the limit of linear control, by reference.

    ``noise_rms`` in um; ``resolution`` of the spectra in Hz; ``gain`` of the linear
    plant at rest in um/V. ``delay`` is the low-frequency delay of the plant's inner
    (all-pass) factor, in samples. ``sensitivity_peak`` is that of the one controller;
    the limit does not bound it. ``dt`` in s.
    """

    references: dict[str, LimitComparison]
    dt: float
    noise_rms: float
    resolution: float
    gain: float
    delay: float
    sensitivity_peak: float
    curves: Curves

    @property
    def worst(self) -> str:
        """Name of the reference with the largest ratio of error to limit."""
        return max(self.references, key=lambda name: self.references[name].ratio)

    def densities(self, name: str) -> dict[str, np.ndarray]:
        """Return one-sided amplitude densities [lines] for ``name``, um/sqrt(Hz).

        They are those of the "unpredicted" disturbance, of the sensor's "noise", of the
        error at the "limit", and of the error of the "tuned" loop.
        """
        i, curves = list(self.references).index(name), self.curves
        spectra = {
            "unpredicted": curves.unpredicted[i],
            "noise": np.full_like(curves.frequency, curves.noise),
            "limit": curves.limit[i],
            "tuned": curves.tuned[i],
        }
        return {key: np.sqrt(2.0 * self.dt * s) for key, s in spectra.items()}

    @property
    def near(self) -> int:
        """Number of references whose error is at most ``NEAR`` times its limit."""
        return sum(one.ratio <= NEAR for one in self.references.values())

    @property
    def near_one_controller(self) -> int:
        """Number of references within ``NEAR`` times the one controller's error."""
        return sum(
            one.tuned <= NEAR * one.one_controller for one in self.references.values()
        )

    @property
    def ratio(self) -> float:
        """Geometric mean over the references of the ratio of error to limit."""
        return self._mean([one.ratio for one in self.references.values()])

    @property
    def ratio_to_one_controller(self) -> float:
        """Geometric mean of the ratio of error to that of the one controller."""
        found = [one.tuned / one.one_controller for one in self.references.values()]
        return self._mean(found)

    @staticmethod
    def _mean(values: list[float]) -> float:
        return float(np.exp(np.mean(np.log(values))))

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        rows = {}
        for name, one in self.references.items():
            plain = asdict(one)
            bandwidth = plain.pop("bandwidth")
            shares = {key: plain.pop(key) for key in ("tuned_shares", "limit_shares")}
            rows[name] = {f"{key}_rms_um": value for key, value in plain.items()}
            rows[name] |= {
                "tuned_over_limit": one.ratio,
                "tuned_over_one_controller": one.tuned / one.one_controller,
                "disturbance_bandwidth_Hz": bandwidth,
                **{f"{key}_rms_um": parts for key, parts in shares.items()},
                "largest_excess": one.largest_excess,
            }
        return {
            "tuned_over_limit": self.ratio,
            "tuned_over_one_controller": self.ratio_to_one_controller,
            "within": NEAR,
            "references_within": self.near,
            "references_within_one_controller": self.near_one_controller,
            "references": len(self.references),
            "noise_rms_um": self.noise_rms,
            "resolution_Hz": self.resolution,
            "plant_gain_um_per_V": self.gain,
            "plant_delay_samples": self.delay,
            "one_controller_sensitivity_peak": self.sensitivity_peak,
            "per_reference": rows,
        }
