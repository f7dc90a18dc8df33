"""Comparison of a loop with the linear-control limit, by reference."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

NEAR = 1.5
"""How many times the limit still counts as near it."""


@dataclass(frozen=True)
class Shares:
    """Parts of an RMS error (um), whose squares add up to its square.

    ``noise`` is what the sensor's noise makes; ``unforeseen`` what is left of the
    disturbance that the reference does not foretell; ``foreseen`` what a linear filter
    of the reference makes of the error: following, and the rest of the disturbance. It
    is what is missing to the whole, 0 where the others alone are more.
    """

    noise: float
    unforeseen: float
    foreseen: float = 0.0


@dataclass(frozen=True)
class Reached:
    """One reference, all RMS figures in um.

    ``tuned`` is the loop's error. ``limit`` is the least that a linear controller made
    for this reference can leave, ``one_controller`` what the one that is best for the
    geometric mean of all references leaves of it. ``disturbance`` is all of d,
    ``unforeseen`` the part that the reference does not foretell, whose spectrum lies
    above the noise's up to ``bandwidth`` (Hz).
    """

    tuned: float
    limit: float
    one_controller: float
    disturbance: float
    unforeseen: float
    bandwidth: float
    tuned_shares: Shares | None
    limit_shares: Shares

    @property
    def over(self) -> float:
        """How many times the limit the loop's error is."""
        return self.tuned / self.limit

    @property
    def exceeding(self) -> str | None:
        """Name of the share whose mean square is furthest above the limit's."""
        if self.tuned_shares is None:
            return None
        least = asdict(self.limit_shares)
        own = asdict(self.tuned_shares)
        return max(own, key=lambda name: own[name] ** 2 - least[name] ** 2)


@dataclass(frozen=True)
class Curves:
    """Spectra by frequency (Hz), in um^2; the mean of a spectrum is a variance.

    ``unforeseen`` [references, lines]; ``noise`` is flat. ``tuned`` and ``limit``
    [references, lines] are of the errors.
    """

    frequency: np.ndarray
    unforeseen: np.ndarray
    noise: float
    tuned: np.ndarray
    limit: np.ndarray


@dataclass(frozen=True)
class LimitReport:
    """Distance of a loop from the limit of linear control, by reference.

    ``noise_rms`` in um; ``resolution`` of the spectra in Hz; ``gain`` of the linear
    plant at rest in um/V and ``delay``, that of the plant's inner part for slow
    motion, in samples. ``sensitivity_peak`` is that of the one controller, which the
    limit does not bound. ``dt`` in s.
    """

    references: dict[str, Reached]
    dt: float
    noise_rms: float
    resolution: float
    gain: float
    delay: float
    sensitivity_peak: float
    curves: Curves

    @property
    def worst(self) -> str:
        """Name of the reference whose error is the most times its limit."""
        return max(self.references, key=lambda name: self.references[name].over)

    def densities(self, name: str) -> dict[str, np.ndarray]:
        """Return one-sided amplitude densities [lines] of a reference, um per root Hz.

        Of the "unforeseen" disturbance, of the sensor's "noise", of the error at the
        "limit", and of the error of the "tuned" loop.
        """
        i, curves = list(self.references).index(name), self.curves
        spectra = {
            "unforeseen": curves.unforeseen[i],
            "noise": np.full_like(curves.frequency, curves.noise),
            "limit": curves.limit[i],
            "tuned": curves.tuned[i],
        }
        return {key: np.sqrt(2.0 * self.dt * s) for key, s in spectra.items()}

    @property
    def near(self) -> int:
        """How many references come within ``NEAR`` times their limit."""
        return sum(one.over <= NEAR for one in self.references.values())

    @property
    def near_one_controller(self) -> int:
        """The same for what the one controller for all references leaves."""
        return sum(
            one.tuned <= NEAR * one.one_controller for one in self.references.values()
        )

    @property
    def over(self) -> float:
        """Geometric mean over the references of error over limit."""
        return self._mean([one.over for one in self.references.values()])

    @property
    def over_one_controller(self) -> float:
        """The same over what the one controller leaves."""
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
                "tuned_over_limit": one.over,
                "tuned_over_one_controller": one.tuned / one.one_controller,
                "disturbance_bandwidth_Hz": bandwidth,
                **{f"{key}_rms_um": parts for key, parts in shares.items()},
                "exceeding": one.exceeding,
            }
        return {
            "tuned_over_limit": self.over,
            "tuned_over_one_controller": self.over_one_controller,
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
