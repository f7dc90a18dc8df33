"""Model of a stage from its measured frequency response."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from pydantic import BaseModel

from ..core.about import About
from ..core.paths import declared
from ..core.system import Affine, Delay, System, series
from ..dynamics import FractionalDelay, Modes
from .estimators.estimate import FittedParameter
from .estimators.modal_fit import MOST_MODES, modal_fit
from .estimators.modal_model import FOLDED, ModalFit, error_bound
from .measured_response import Measurement
from .records.response import FrequencyResponse

SMALL_MOTIONS = (
    "a frequency response shows small motions: hysteresis and creep are not in the "
    "model, and with hysteresis the gain for large motions is larger, which takes as "
    "much from the gain margin; identify them from a slow record of the whole range"
)
LONGEST = 32
"""Longest delay, in samples, that is interpolated; the rest of a longer one is a whole
number of samples."""

CERTAIN = 2.0
"""Standard errors above which a delay counts as found."""

LARGE = 2.0
"""Ratio of the residual's mean square to the variance above which a note reports it."""


class ResponseReport(BaseModel):
    """Report of a model from a frequency response, the content of ``response.json``.

    ``error`` is the median of the relative error of the model at the measured lines,
    ``noise`` that of the noise, as a standard deviation. ``excess`` is the mean square
    of the residual relative to the variance of the lines, None if that is not known.
    ``measured`` tells how the response was measured, if from records.
    """

    source: str
    unit: str
    lines: int
    found: str
    parameters: dict[str, FittedParameter]
    error: float
    noise: float
    excess: float | None = None
    measured: Measurement | None = None
    notes: list[str]


@dataclass(frozen=True)
class ResponseModel:
    """A System fitted to a frequency response, its report and the details of the fit.

    ``system`` is a gain, ``Modes`` and a delay in series.
    """

    system: System
    report: ResponseReport
    response: FrequencyResponse
    fit: ModalFit
    about: About


def identify_response(
    response: FrequencyResponse,
    rate: float,
    *,
    held: bool = False,
    most: int = MOST_MODES,
    measured: Measurement | None = None,
) -> ResponseModel:
    """Return the modes, lag and delay of ``response`` as a System at ``rate`` (Hz).

    If the response does not state how it was measured, ``held`` tells that converters
    at this rate held its input; otherwise an analogue analyser is assumed. At most
    ``most`` modes are fitted; the lines are weighted by the variances of the response,
    if it has any. ``measured`` goes into the report. The saved model carries a bound on
    its error, so that a study requires robustness to errors that the response does not
    show. Raises ValueError for a rate that is not above 0, a mode too near half the
    rate, and a response that no mode explains.
    """
    if not (math.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate:g} Hz; it must be above 0")
    dt = 1.0 / rate
    fit = modal_fit(response, held=dt if held else None, most=most)
    highest = max(mode.value for mode in fit.frequency)
    if highest > FOLDED * 0.5 * rate:
        raise ValueError(
            f"a mode at {highest:.4g} Hz cannot be simulated at {rate:g} Hz: choose a "
            "higher rate, or leave out the lines above it"
        )
    system = _system_of(fit, dt)
    output, _, input = (part.strip() for part in response.unit.partition("/"))
    relative = abs(response.values / fit.fitted - 1.0)
    noise = math.sqrt(2.0) * fit.deviation / abs(fit.fitted)
    parameters = _parameters(fit)
    report = ResponseReport(
        source=response.source,
        unit=response.unit,
        lines=response.frequency.size,
        found=_words(fit),
        parameters=parameters,
        error=float(sorted(relative)[relative.size // 2]),
        noise=float(sorted(noise)[noise.size // 2]),
        excess=fit.excess,
        measured=measured,
        notes=[SMALL_MOTIONS, *_notes(fit, response)],
    )
    about = About(
        record=response.source or None,
        rate_Hz=rate,
        units={"input": input, "output": output},
        parameter_units=_units(system, parameters, response.unit),
        error_bound=error_bound(fit, response, fit.deviation, dt),
        standard_errors={
            path: one.standard_error
            for path, one in parameters.items()
            if one.standard_error is not None and path != "gain.gain"
        },
        small_motions=True,
    )
    return ResponseModel(system, report, response, fit, about)


def _notes(fit: ModalFit, response: FrequencyResponse) -> Iterator[str]:
    """Yield notes on merged lines, a large residual and biased damping."""
    if fit.searched < response.frequency.size:
        yield (
            f"the search merged {response.frequency.size} lines into {fit.searched}; "
            "the last descent used all"
        )
    if fit.excess is not None and fit.excess > LARGE:
        yield (
            f"the residual is {math.sqrt(fit.excess):.2g} times as large as the "
            "variance of the response explains: the stage does more than these modes, "
            "lag and delay; the standard errors are larger by this factor"
        )
    for mode, damping in zip(fit.frequency, fit.damping, strict=True):
        width = 2.0 * damping.value * mode.value
        if response.resolution > width:
            yield (
                f"a line was estimated from a band of {response.resolution:.3g} Hz, "
                f"and the resonance at {mode.value:.5g} Hz is {width:.3g} Hz wide: its "
                "damping is biased; record longer, or a multisine with --period"
            )


def _system_of(fit: ModalFit, dt: float) -> System:
    gain, delay = fit.static_gain.value, fit.delay.value
    modes = Modes(
        [one.value for one in fit.frequency],
        [one.value for one in fit.damping],
        dt,
        [one.value for one in fit.share],
        [] if fit.lag is None else [fit.lag.value],
    )
    parts: dict[str, System] = {"gain": Affine(gain), "dynamics": modes}
    if delay > 0.0:
        whole = max(0, math.floor(delay / dt) - LONGEST)
        if whole:
            parts["whole_delay"] = Delay(whole)
        rest = delay - whole * dt
        longest = max(1, math.ceil(rest / dt))
        parts["delay"] = FractionalDelay(rest, dt, longest, order=3)
    return series(**parts)


def _parameters(fit: ModalFit) -> dict[str, FittedParameter]:
    """Return the parameters of the System, by path, with their standard errors."""
    found = {"gain.gain": fit.static_gain}
    for i, (frequency, damping) in enumerate(
        zip(fit.frequency, fit.damping, strict=True)
    ):
        found[f"dynamics.frequency.{i}"] = frequency
        found[f"dynamics.damping.{i}"] = damping
    for i, one in enumerate(fit.share):
        found[f"dynamics.share.{i}"] = one
    if fit.lag is not None:
        found["dynamics.time_constant.0"] = fit.lag
    if fit.delay.value > 0.0:
        found["delay.delay"] = fit.delay
    return {
        path: FittedParameter(value=value, standard_error=error)
        for path, (value, error) in found.items()
    }


def _units(system: System, paths: Iterable[str], unit: str) -> dict[str, str]:
    known = {path: declared(system, path) for path in paths}
    units = {path: one.unit if one else "" for path, one in known.items()}
    return units | {"gain.gain": unit}


def _words(fit: ModalFit) -> str:
    modes = [
        f"{frequency.value:.5g} Hz with {100.0 * damping.value:.3g} % damping"
        for frequency, damping in zip(fit.frequency, fit.damping, strict=True)
    ]
    several = "a resonance" if len(modes) == 1 else "resonances"
    lag = "" if fit.lag is None else f", a lag of {1e3 * fit.lag.value:.3g} ms"
    shown = fit.delay.value > CERTAIN * fit.delay.error
    delay = f", a delay of {1e6 * fit.delay.value:.3g} us" if shown else ""
    return f"{several} at {' and '.join(modes)}{lag}{delay}"
