"""Frequency response of a stage in a closed loop, by three approaches.

With feedback ``u = K_r r + d - K_y y`` and the output ``y = G u + v``, noise reaches
the input. From the input to the output the cross spectrum gives

    (G S_w - conj(K_y) S_v) / (S_w + |K_y|^2 S_v)

with the spectra S_w of ``K_r r + d`` and S_v of v: this is the response of the stage
where the excitation is strong, and ``-1 / K_y`` where the noise is strong (Ljung,
System Identification, 2nd ed., 13.4). The approaches ``indirect`` and ``joint`` use
only the part of the signals that is correlated with the excitation.
"""

from typing import NamedTuple

import numpy as np

from ...core.feedback import Observation
from ...core.system import System
from ...dynamics import linearise
from ..records.record import Record
from .projection import check_excitation
from .welch import (
    EXCITED,
    OVERLAP,
    SpectralResponse,
    segment_size,
    spectral_response,
)

CONDITION = 1e-9
"""Regularisation of the spectrum matrix of the excitations, as a share of its trace."""


def loop_response(
    record: Record,
    approach: str,
    controller: System | None = None,
    *,
    segment: int | None = None,
) -> SpectralResponse:
    """Estimate the frequency response of the stage from a record of a closed loop.

    ``direct`` is the estimate of Welch from input to output. The noise in the input
    biases it towards ``-1 / K_y``, where ``-K_y`` is the response of the controller
    from output to input. ``joint`` is the ratio of the responses of output and input to
    the excitation; ``indirect`` computes the response of the input from the
    ``controller``. Both are unbiased for long records, whatever the noise, but an error
    of the controller biases ``indirect``. A reference and a dither are weighted by
    their power. ``segment`` as for ``spectral_response``. For a periodic record, direct
    and joint average over the periods and give the same result.

    Raises ValueError for another approach, a record without an excitation, or
    ``indirect`` without a controller.
    """
    if approach == "direct":
        return spectral_response(
            record.input,
            record.output,
            record.dt,
            period=record.period,
            segment=segment,
        )
    if approach == "joint":
        return joint_response(
            record.input,
            record.output,
            record.excitation,
            record.dt,
            period=record.period,
            segment=segment,
        )
    if approach != "indirect":
        raise ValueError(
            f"approach {approach!r} is unknown; there are direct, indirect and joint"
        )
    if controller is None:
        raise ValueError("indirect needs the controller of the loop")
    return _indirect(record, controller, segment)


def joint_response(
    input: np.ndarray,
    output: np.ndarray,
    excitation: np.ndarray,
    dt: float,
    *,
    period: int | None = None,
    segment: int | None = None,
    least: float = EXCITED,
) -> SpectralResponse:
    """Estimate the ratio of the responses of ``output`` and ``input`` to an excitation.

    ``excitation`` is [samples, k], the other signals are [samples]; the other arguments
    are those of ``spectral_response``. If the noise is independent of the excitation,
    the estimate is unbiased for long records. The ``power`` returned is the part of the
    input power that the excitation explains.

    Raises ValueError for an excitation that never changes, and as
    ``spectral_response`` does.
    """
    check_excitation(excitation)
    if period is not None:
        return spectral_response(input, output, dt, period=period, least=least)
    found = _spectra(input, output, excitation, dt, segment)
    return _ratio(found, _responses(found, found.input), least)


class _Spectra(NamedTuple):
    """Spectra of a record, by line.

    ``excitation`` [lines, k, k] is the spectrum matrix of the excitations, ``input``
    and ``output`` [lines, k] are the cross spectra of both signals with them. ``power``
    and ``total`` [lines] are the powers of input and output, ``cross`` [lines] is their
    cross spectrum, ``averages`` the number of averages.
    """

    frequency: np.ndarray
    excitation: np.ndarray
    input: np.ndarray
    output: np.ndarray
    power: np.ndarray
    total: np.ndarray
    cross: np.ndarray
    averages: float


def _spectra(
    input: np.ndarray,
    output: np.ndarray,
    excitation: np.ndarray,
    dt: float,
    segment: int | None,
) -> _Spectra:
    import scipy.signal  # takes long to import

    size, count = segment_size(input.size, segment)
    settings = {"fs": 1.0 / dt, "nperseg": size, "detrend": "linear"}
    settings["scaling"] = "spectrum"

    def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.asarray(scipy.signal.csd(one, other, **settings)[1])

    signals = list(excitation.T)
    return _Spectra(
        np.fft.rfftfreq(size, dt),
        np.stack([[cross(a, b) for b in signals] for a in signals]).transpose(2, 0, 1),
        np.stack([cross(a, input) for a in signals], axis=1),
        np.stack([cross(a, output) for a in signals], axis=1),
        np.real(cross(input, input)),
        np.real(cross(output, output)),
        cross(input, output),
        OVERLAP * count,
    )


def _responses(found: _Spectra, signal: np.ndarray) -> np.ndarray:
    """Return the responses [lines, k] of a ``signal`` to the excitations."""
    spectrum = found.excitation
    size = np.real(np.trace(spectrum, axis1=1, axis2=2))[:, None, None]
    spectrum = spectrum + CONDITION * (size + np.finfo(float).tiny) * np.eye(
        spectrum.shape[1]
    )
    return np.linalg.solve(spectrum, signal[:, :, None])[:, :, 0]


def _ratio(found: _Spectra, input: np.ndarray, least: float) -> SpectralResponse:
    """Return the response of the output over the responses ``input`` [lines, k]."""
    output = _responses(found, found.output)
    power = np.real(_product(input, found.excitation, input))
    across = _product(input, found.excitation, output)
    alternating = np.r_[0.0, power[1:]]
    kept = np.flatnonzero(alternating > least * alternating.max())
    response = across[kept] / power[kept]
    noise = (
        found.total[kept]
        - 2.0 * np.real(np.conj(response) * found.cross[kept])
        + np.abs(response) ** 2 * found.power[kept]
    )
    explained = np.real(_product(output, found.excitation, output))[kept]
    return SpectralResponse(
        found.frequency[kept],
        response,
        noise.clip(0.0) / power[kept] / found.averages,
        np.clip(explained / np.maximum(found.total[kept], 1e-300), 0.0, 1.0),
        power[kept],
        found.averages,
    )


def _product(left: np.ndarray, spectrum: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.einsum("li,lij,lj->l", left.conj(), spectrum, right)


def _indirect(
    record: Record, controller: System, segment: int | None
) -> SpectralResponse:
    check_excitation(record.excitation)
    found = _spectra(record.input, record.output, record.excitation, record.dt, segment)
    by_reference, by_output = controller_responses(
        controller, found.frequency, record.dt
    )
    moving = {
        "reference": by_reference,
        "dither": np.ones(found.frequency.size, complex),
    }
    own = [
        moving[name]
        for name in moving
        if getattr(record, name) is not None and np.ptp(getattr(record, name)) > 0.0
    ]
    output = _responses(found, found.output)
    input = np.stack(own, axis=1) + by_output[:, None] * output
    return _ratio(found, input, EXCITED)


def controller_responses(
    controller: System, frequency: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the responses [lines] of the command to the reference and to the output.

    ``frequency`` [lines] in Hz. The applied voltage of a sample is the command of the
    sample before. At 0 Hz, where a controller may have a pole, both responses are 0.
    """
    rest = Observation(0.0, 0.0, 0.0, 0.0)
    model = linearise(controller, rest, dt=dt)
    lines = np.where(frequency > 0.0, frequency, 0.25 / dt)
    found = np.asarray(model.frequency_response(lines))[:, 0]
    later = np.exp(2j * np.pi * lines * dt)
    own = 1.0 - found[:, 3] / later
    alive = frequency > 0.0
    return (
        np.where(alive, (found[:, 0] + later * found[:, 1]) / own, 0.0),
        np.where(alive, found[:, 2] / own, 0.0),
    )
