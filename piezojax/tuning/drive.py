"""Figures of the voltage at the piezo: noise, slew rate, current and power."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

HIGH = 0.1
"""Share of the sampling rate above which a part of the voltage counts as high-frequency
drive."""


class Drive(BaseModel):
    """Figures of the voltage u at the piezo, behind the amplifier, of one axis.

    On a stage whose commands are in another unit than V, such as one with decoupled
    axes, that unit replaces V.

    - ``noise_rms_V``: standard deviation of u while the loop holds a constant
      reference, the first value of the first reference, under the sensor's noise alone;
    - ``high_frequency_rms_V``: rms of the part of u above ``HIGH`` times the rate;
    - ``slew_rms_V_per_s``, ``slew_peak_V_per_s``: rms and peak of the slew rate, the
      change of u between two samples over the sample time;
    - ``current_rms_A``, ``current_peak_A``: the same slew rate times the capacitance C;
    - ``power_W``: mean of the absolute power u i, at which the stored energy C u^2 / 2
      changes.

    All but the first are the largest over the held-out references, each with its first
    noise draw, from ``references.settle`` on; the peak of the current is that of the
    whole run. Figures
    that need the capacitance are None without it, and all figures of a run that
    diverged are None.
    """

    noise_rms_V: float | None  # noqa: N815
    high_frequency_rms_V: float | None  # noqa: N815
    slew_rms_V_per_s: float | None  # noqa: N815
    slew_peak_V_per_s: float | None = None  # noqa: N815
    current_rms_A: float | None = None  # noqa: N815
    current_peak_A: float | None = None  # noqa: N815
    power_W: float | None = None  # noqa: N815


def drive_of(
    runs: Sequence[Float[np.ndarray, " samples"]],
    held: Float[np.ndarray, " samples"],
    dt: float,
    start: int,
    capacitance: float | None,
) -> Drive:
    """Return the figures of the voltages (V) of ``runs`` and of the run ``held``.

    ``held`` is the run on a constant reference. ``start`` is the first sample that
    counts, ``dt`` in s, ``capacitance`` in F.
    """
    slews = [np.diff(run) / dt for run in runs]
    slew = _largest([_rms(each[start:]) for each in slews])
    found = {
        "noise_rms_V": _largest([np.std(held[start:])]),
        "high_frequency_rms_V": _largest([_rms_above(run[start:]) for run in runs]),
        "slew_rms_V_per_s": slew,
        "slew_peak_V_per_s": _largest([np.abs(each[start:]).max() for each in slews]),
    }
    if capacitance is not None and slew is not None:
        energies = [0.5 * capacitance * run[start:] ** 2 for run in runs]
        powers = [np.mean(np.abs(np.diff(energy))) / dt for energy in energies]
        peak = _largest([np.max(np.abs(each)) for each in slews])
        found |= {
            "current_rms_A": capacitance * slew,
            "current_peak_A": None if peak is None else capacitance * peak,
            "power_W": _largest(powers),
        }
    return Drive(**found)


def _largest(values: Sequence[float | np.floating]) -> float | None:
    """Return the largest value, None if any is not finite."""
    found = np.asarray(values, float)
    return float(found.max()) if np.isfinite(found).all() else None


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _rms_above(voltage: Float[np.ndarray, " samples"]) -> float:
    """Return the rms of the part of ``voltage`` above ``HIGH`` times the rate.

    A Hann window reduces the leakage of slow motion into high frequencies.
    """
    count = voltage.size
    window = np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2
    spectrum = np.abs(np.fft.fft(window * (voltage - voltage.mean()))) ** 2
    high = np.abs(np.fft.fftfreq(count)) > HIGH
    return float(np.sqrt(np.sum(spectrum[high]) / (count * np.sum(window**2))))
