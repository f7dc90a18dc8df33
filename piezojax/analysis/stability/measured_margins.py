"""Margins of a loop from the measured frequency response of its plant."""

import numpy as np
from jaxtyping import Complex, Float
from pydantic import BaseModel

from .conserved import LinearLoop

FOLDED = 0.999
"""Frequency up to which measured lines count, as a share of half the rate."""

Lines = Float[np.ndarray, " lines"]
Response = Complex[np.ndarray, " lines"]


class MeasuredMargins(BaseModel):
    """Margins of a loop whose plant is known at ``lines`` measured frequencies only.

    ``stable`` is True if 1 + L encircles 0 as often as with the model, with which the
    loop is stable. ``sensitivity_peak`` is the largest |S| at a line, at
    ``sensitivity_peak_Hz``, and ``disk_margin`` is 1 / max |(S - T)/2| over the lines,
    None in a result of an older version. ``gain_margin_dB`` is the smallest gain above
    1 that makes the loop unstable, ``phase_margin_deg`` the smallest such phase, lag or
    lead, and ``delay_margin_samples`` the smallest such delay. Each is interpolated
    between two lines, and None if no such change moves L to -1 within the lines. They
    extend from ``lowest_Hz`` to ``highest_Hz``; nothing is known outside this band.
    """

    lines: int
    lowest_Hz: float  # noqa: N815
    highest_Hz: float  # noqa: N815
    stable: bool
    sensitivity_peak: float
    sensitivity_peak_Hz: float  # noqa: N815
    gain_margin_dB: float | None  # noqa: N815
    phase_margin_deg: float | None
    delay_margin_samples: float | None
    disk_margin: float | None = None


def measured_margins(
    loop: LinearLoop, frequency: Lines, ratio: Response
) -> MeasuredMargins:
    """Return the margins of ``loop`` with its plant multiplied by ``ratio``.

    ``frequency`` (Hz, increasing) are the measured lines and ``ratio`` the measured
    response over that of the model there: L = C P_model P_measured / P_model. The model
    contains the effect of sampling on an analogue response. Lines above half the rate
    do not count. Raises ValueError if fewer than two are left.
    """
    kept = frequency < FOLDED * 0.5 / loop.dt
    frequency, ratio = frequency[kept], ratio[kept]
    if frequency.size < 2:
        raise ValueError(
            f"{frequency.size} measured lines lie below half the rate, "
            f"{0.5 / loop.dt:g} Hz; margins need two"
        )
    angle = 2.0 * np.pi * frequency * loop.dt
    modelled = loop.response(angle)
    L = ratio * modelled
    size = 1.0 / np.abs(1.0 + L)
    peak = int(np.argmax(size))
    gains = _gain_margins(L)
    phases, delays = _phase_margins(L, angle)
    return MeasuredMargins(
        lines=frequency.size,
        lowest_Hz=float(frequency[0]),
        highest_Hz=float(frequency[-1]),
        stable=_encirclements(L, modelled) == 0,
        sensitivity_peak=float(size[peak]),
        sensitivity_peak_Hz=float(frequency[peak]),
        gain_margin_dB=20.0 * float(np.log10(gains.min())) if gains.size else None,
        phase_margin_deg=float(np.degrees(phases.min())) if phases.size else None,
        delay_margin_samples=float(delays.min()) if delays.size else None,
        disk_margin=2.0 / float(np.max(np.abs(1.0 - L) * size)),
    )


def _encirclements(L: Response, modelled: Response) -> int:
    """Return the encirclements of 0 by 1 + L, less those with the model.

    The ratio (1 + L) / (1 + L_model) is real at 0 Hz and at half the rate. The change
    of its phase from the first to the last line is therefore rounded to a multiple of
    pi.
    """
    change = (1.0 + L) / (1.0 + modelled)
    phase = np.unwrap(np.angle(change))
    return round(float(phase[-1] - phase[0]) / np.pi)


def _gain_margins(L: Response) -> Float[np.ndarray, " crossings"]:
    """Return the gains above 1 that move a point of the curve to -1."""
    imaginary, real = np.imag(L), np.real(L)
    at = np.flatnonzero(imaginary[:-1] * imaginary[1:] < 0.0)
    share = imaginary[at] / (imaginary[at] - imaginary[at + 1])
    crossing = real[at] + share * (real[at + 1] - real[at])
    gains = -1.0 / crossing[crossing < 0.0]
    return gains[gains > 1.0]


def _phase_margins(
    L: Response, angle: Lines
) -> tuple[Float[np.ndarray, " crossings"], Float[np.ndarray, " crossings"]]:
    """Return the phases (rad) and delays (samples) that move a point to -1."""
    size = np.log(np.maximum(np.abs(L), np.finfo(float).tiny))
    phase = np.unwrap(np.angle(L))
    at = np.flatnonzero(size[:-1] * size[1:] < 0.0)
    share = size[at] / (size[at] - size[at + 1])
    crossing = phase[at] + share * (phase[at + 1] - phase[at])
    frequency = angle[at] + share * (angle[at + 1] - angle[at])
    lag = np.mod(crossing + np.pi, 2.0 * np.pi)
    return np.minimum(lag, 2.0 * np.pi - lag), lag / frequency
