"""Frequency responses from time-domain records, by amplitude of the input."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import BaseModel

from .estimators.line_noise import smoothed
from .estimators.local_polynomial import local_polynomial, periodic_local_polynomial
from .estimators.loop_response import joint_response
from .estimators.robust import LineEstimates, robust_response, steady_response
from .estimators.welch import SpectralResponse, segment_length, spectral_response
from .records.record import Record
from .records.response import FrequencyResponse

ALIKE = 1.1
"""Ratio of rms amplitudes below which two records count as equal in amplitude."""

HIGHEST = 0.8
"""Share of half the rate below which the response to a held input is kept: near half
the rate the image of a component is as large as the component itself."""

CERTAIN = 3.0
"""Standard errors by which the total variance must exceed the noise."""

RESPONSE_METHODS = {
    "welch": "averaged spectra of any record, with coherence, in a closed loop of the "
    "responses to its excitation; its band does not include leakage",
    "local_polynomial": "any record, or periodic with a transient; no leakage",
    "robust": "periods of multisines in steady state; several realisations tell "
    "nonlinear distortion from noise",
}
"""Methods by name, with a summary."""


class ResponseSettings(BaseModel):
    """Settings of a measurement of responses.

    ``realisations`` follow one another in each record. ``skip`` is the number of
    periods that robust leaves out at the start of each realisation, ``segment`` the
    number of samples in a segment of welch. With ``held`` the input was held between
    samples, as by converters.
    """

    method: str
    realisations: int = 1
    skip: int = 1
    segment: int | None = None
    held: bool = True


class Measurement(BaseModel):
    """Origin and quality of a response from records.

    ``amplitude`` is the rms deviation of the input from its mean, in ``input_unit``.
    ``band_percent`` is half the 95 % band of the magnitude, ``noise_percent`` the
    deviation due to noise and ``distortion_percent`` that of the nonlinear distortion
    of one realisation, each relative to the magnitude, the median over the lines; None
    where it is not known. ``resolution_Hz`` is the width of the band from which a line
    was estimated, 0 for a line by itself. ``coherence`` is the median over the lines.
    """

    method: str
    records: list[str]
    realisations: int
    amplitude: float
    input_unit: str
    lines: int
    lowest_Hz: float  # noqa: N815
    highest_Hz: float  # noqa: N815
    resolution_Hz: float  # noqa: N815
    band_percent: float
    noise_percent: float | None
    distortion_percent: float | None
    coherence: float | None
    notes: list[str]


def measure_responses(
    records: Sequence[Record], settings: ResponseSettings
) -> list[tuple[FrequencyResponse, Measurement]]:
    """Return the response at each amplitude of the ``records``, the lowest first.

    Records with the same rms amplitude of the input (``ALIKE``) are realisations of one
    response: they are averaged. Two or more periodic ones separate nonlinear distortion
    from noise. In a closed loop welch takes the ratio of the responses to reference and
    dither, which noise does not bias.

    Raises ValueError for an unknown method, records of several inputs or outputs or of
    different sample times, units or periods, a local polynomial of a closed loop
    without a period, and as the methods do.
    """
    if settings.method not in RESPONSE_METHODS:
        raise ValueError(
            f"--method {settings.method!r} is unknown; for a response there are "
            f"{', '.join(RESPONSE_METHODS)}"
        )
    _check(records, settings)
    parts = [part for record in records for part in _split(record, settings)]
    parts.sort(key=_amplitude)
    groups: list[list[Record]] = []
    for part in parts:
        if groups and _amplitude(part) < ALIKE * _amplitude(groups[-1][0]):
            groups[-1].append(part)
        else:
            groups.append([part])
    return [_measured(group, settings) for group in groups]


def _amplitude(record: Record) -> float:
    return float(np.std(record.input))


def _check(records: Sequence[Record], settings: ResponseSettings) -> None:
    kinds = {
        (round(1.0 / r.dt, 6), r.period, r.input_unit, r.output_unit)
        for r in records
        if r.input.size and r.output.size  # each raises ValueError for several
    }
    if len(kinds) > 1:
        raise ValueError(
            "the records differ in (rate, period, unit of input, of output): "
            f"{sorted(kinds, key=str)}; they must be the same"
        )
    period = records[0].period
    if settings.method == "robust" and period is None:
        raise ValueError(
            "robust needs the --period of the multisine, in samples; local_polynomial "
            "takes any record"
        )
    if settings.method == "welch" and period is not None:
        raise ValueError(
            "welch does not use a period: local_polynomial and robust do, without "
            "leakage"
        )
    if settings.method == "local_polynomial" and period is None:
        for record in records:
            if record.closed_loop:
                raise ValueError(
                    f"{record.source}: local_polynomial takes the input as free of "
                    "noise, and in a closed loop it is not: use welch, or a periodic "
                    "reference and its --period"
                )


def _split(record: Record, settings: ResponseSettings) -> list[Record]:
    """Return the realisations in a record."""
    count = settings.realisations
    if count == 1:
        return [record]
    size = record.samples // count
    return [record.during(slice(i * size, (i + 1) * size)) for i in range(count)]


def _measured(
    records: Sequence[Record], settings: ResponseSettings
) -> tuple[FrequencyResponse, Measurement]:
    first = records[0]
    sources = list(dict.fromkeys(record.source for record in records))
    notes: list[str] = []
    properties = {
        "unit": f"{first.output_unit}/{first.input_unit}",
        "source": ", ".join(sources),
        "realisations": len(records),
        "amplitude": float(np.mean([_amplitude(record) for record in records])),
        "held": first.dt if settings.held else None,
    }
    if settings.method == "welch":
        found = _by_welch(records, settings, properties)
    elif first.period is None:
        found = _averaged(
            [local_polynomial(r.input, r.output, r.dt) for r in records], properties
        )
    else:
        found = _periodic(records, settings, properties, notes)
    if settings.held:
        found = _below(found, HIGHEST * 0.5 / first.dt)
    return found, _measurement(found, sources, settings, first.input_unit, notes)


def _below(found: FrequencyResponse, highest: float) -> FrequencyResponse:
    """Return the lines of ``found`` below the frequency ``highest`` (Hz)."""
    count = int(np.searchsorted(found.frequency, highest))
    columns = {
        name: None if part is None else part[:count]
        for name in ("frequency", "values", "variance", "noise", "coherence")
        for part in [getattr(found, name)]
    }
    return replace(found, **columns)


def _by_welch(
    records: Sequence[Record], settings: ResponseSettings, properties: dict
) -> FrequencyResponse:
    size = settings.segment or segment_length(min(r.samples for r in records))
    each = [_of_welch(record, size) for record in records]
    # Variance of a regression with one unknown: divide by one average less.
    estimates = [
        LineEstimates(
            one.frequency,
            one.response,
            one.variance * one.averages / max(one.averages - 1.0, 0.5),
            2.0 * max(one.averages - 1.0, 0.5),
            2.0 / (size * records[0].dt),
        )
        for one in each
    ]
    coherence = None
    if len({one.frequency.size for one in each}) == 1:
        coherence = np.mean([one.coherence for one in each], axis=0)
    return _averaged(estimates, properties | {"coherence": coherence})


def _of_welch(record: Record, segment: int) -> SpectralResponse:
    """Return the response of the stage, in a closed loop from its excitation."""
    input, output, dt, least = record.input, record.output, record.dt, 1e-4
    if record.closed_loop:
        return joint_response(
            input, output, record.excitation, dt, segment=segment, least=least
        )
    return spectral_response(input, output, dt, segment=segment, least=least)


def _averaged(each: Sequence[LineEstimates], properties: dict) -> FrequencyResponse:
    """Return the mean of responses whose variance holds noise and distortion."""
    first = each[0]
    if any(
        one.frequency.shape != first.frequency.shape
        or not np.allclose(one.frequency, first.frequency)
        for one in each
    ):
        raise ValueError(
            "the records of one amplitude must have the same length and excite the "
            f"same lines: {properties['source']}"
        )
    return FrequencyResponse(
        first.frequency,
        np.mean([one.response for one in each], axis=0),
        variance=np.mean([one.variance for one in each], axis=0) / len(each),
        freedom=sum(one.freedom for one in each),
        resolution=first.resolution,
        **properties,
    )


def _periodic(
    records: Sequence[Record],
    settings: ResponseSettings,
    properties: dict,
    notes: list[str],
) -> FrequencyResponse:
    each = []
    for record in records:
        signals = record.input, record.output, record.dt, record.period or 0
        if settings.method == "robust":
            each.append(steady_response(*signals, settings.skip))
        else:
            each.append(periodic_local_polynomial(*signals))
    if len(each) == 1:
        notes.append(
            "one realisation: the band includes the noise but no nonlinear distortion; "
            "repeat the measurement with other random phases"
        )
        return _averaged(each, properties)
    found = robust_response(each)
    return FrequencyResponse(
        found.frequency,
        found.response,
        variance=found.total,
        noise=found.noise,
        freedom=found.freedom,
        **properties,
    )


def _measurement(
    found: FrequencyResponse,
    sources: list[str],
    settings: ResponseSettings,
    input_unit: str,
    notes: list[str],
) -> Measurement:
    gain = np.abs(found.values)

    def percent(deviation: np.ndarray) -> float:
        return 100.0 * float(np.median(deviation / np.maximum(gain, 1e-300)))

    noise, distortion, coherence = found.noise, found.distortion, found.coherence
    if found.realisations == 1 and settings.method != "welch" and not found.resolution:
        noise = found.variance
    level = None
    if found.noise is not None and distortion is not None:
        level = distortion_level(found)
        if level is None:
            notes.append("the realisations differ by no more than the noise")
    return Measurement(
        method=settings.method,
        records=sources,
        realisations=found.realisations,
        amplitude=found.amplitude or 0.0,
        input_unit=input_unit,
        lines=found.frequency.size,
        lowest_Hz=float(found.frequency[0]),
        highest_Hz=float(found.frequency[-1]),
        resolution_Hz=found.resolution,
        band_percent=percent(found.band()[0]),
        noise_percent=None if noise is None else percent(np.sqrt(noise)),
        distortion_percent=None if level is None else percent(level),
        coherence=None if coherence is None else float(np.median(coherence)),
        notes=notes,
    )


def distortion_level(found: FrequencyResponse) -> np.ndarray | None:
    """Return the deviation [lines] of the distortion of a realisation, smoothed.

    None if it was not separated from the noise, or if the total variance does not
    exceed that of the noise by ``CERTAIN`` standard errors.
    """
    distortion, noise, total = found.distortion, found.noise, found.variance
    if distortion is None or noise is None or total is None:
        return None
    level = np.maximum(smoothed(noise, found.freedom), 1e-300)
    ratio = float(np.sum(total / level) / max(np.sum(noise / level), 1e-300))
    error = np.sqrt(4.0 / (found.freedom * found.frequency.size))
    if ratio < 1.0 + CERTAIN * error:
        return None
    return np.sqrt(smoothed(distortion, found.freedom).clip(0.0))
