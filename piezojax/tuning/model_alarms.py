"""Alarms of the model of a plant, from its fit and from the bound on its error."""

from collections.abc import Callable, Iterator

import numpy as np

from ..analysis.stability import StabilityReports
from ..core.about import About
from ..core.error_bound import ErrorBound

DECADES = 5.0
"""Decades below the Nyquist frequency in which the model error is compared."""

SLACK = 0.05
"""Relative excess over the limit of Ms that does not count: this check samples a
lightly damped mode at more lines than the search does."""


def model_alarms(
    about: About, fitted: bool, limit: float, stability: StabilityReports
) -> Iterator[str]:
    """Yield the alarms of the model of a plant, each with a next step.

    They are those of its fit and of its check on other records, one if it was
    ``fitted`` in this study without a bound on its error, and one if the tuned loop can
    be unstable, or its Ms can exceed ``limit``, within that bound. ``about`` is the
    origin of the model, also of one that a study accepts in spite of its alarms;
    ``stability`` holds the linear loops "after".
    """
    bound = about.error_bound
    yield from about.unsafe
    if fitted and bound is None:
        yield _no_bound(about)
    if bound is not None and "after" in stability.loops:
        yield from _error_alarm(bound, limit, stability)


def worst_peak(
    bound: Callable[[np.ndarray], np.ndarray], stability: StabilityReports
) -> tuple[float, float]:
    """Return the largest Ms of the tuned loop within ``bound``, and its frequency (Hz).

    ``bound`` returns the relative error l of the plant at frequencies in Hz. The worst
    |S| under it is |S| / (1 - l |T|); Ms is infinite if a plant within the bound makes
    the loop unstable. ``stability`` holds the linear loops "after".
    """
    worst, at = 0.0, 0.0
    for curves in stability.curves("after", DECADES).values():
        share = bound(curves.frequency) * np.abs(curves.T)
        peak = int(np.argmax(share))
        reached = np.inf
        if share[peak] < 1.0:
            size = np.abs(curves.S) / (1.0 - share)
            peak = int(np.argmax(size))
            reached = float(size[peak])
        if reached > worst:
            worst, at = reached, float(curves.frequency[peak])
    return worst, at


def _no_bound(about: About) -> str:
    """Return the alarm of a plant without a bound on the error of its model."""
    inputs, outputs = len(about.input_ranges), len(about.residual_rms)
    if max(inputs, outputs) <= 1:
        return (
            "the record gives no bound on the error of the fitted plant: use a longer "
            "record whose voltage and displacement move throughout"
        )
    return (
        f"the fitted plant has {inputs} inputs and {outputs} outputs, and no bound on "
        "the error of its model: bounds are known for one input and one output only, "
        "so the margins hold for the model alone; give the model's uncertainty in "
        "[ensemble], and raise the gains on the stage in small steps"
    )


def _error_alarm(
    bound: ErrorBound, limit: float, stability: StabilityReports
) -> Iterator[str]:
    """Yield an alarm if the model's error can make Ms exceed ``limit``."""
    worst, at = worst_peak(bound.at, stability)
    if np.isfinite(worst) and worst <= limit * (1.0 + SLACK):
        return
    here = np.array([at])
    result = (
        f"raise Ms to {worst:.3g} (limit {limit:g})"
        if np.isfinite(worst)
        else "make the loop unstable"
    )
    if bound.excited_at(here).all():
        yield (
            f"at {at:.4g} Hz the model may be wrong by {bound.at(here)[0]:.2g} times "
            f"its own gain, which could {result}: fit a better model (--model all), "
            "or tune for a lower bandwidth"
        )
    else:
        yield (
            f"the record excites nothing at {at:.4g} Hz, where the loop still acts; a "
            f"resonance that the model lacks could {result}: record a chirp of small "
            "amplitude up to half the rate (python -m piezojax.excite writes a record) "
            "or a response, or tune for a lower bandwidth"
        )


def unchecked(about: About, response: bool = False) -> list[str]:
    """Return a note if a fitted model was never checked on a second record.

    ``response`` is whether the plant of the study is fitted to a frequency response.
    """
    if about.record is None or about.checked:
        return []
    second, advice = _AGAIN["response" if response else "record"]
    return [
        f"the model of the plant was fitted to {about.record} and never checked on a "
        f"second {second}: nothing shows that it holds for this stage today; {advice}"
    ]


_AGAIN = {
    "record": (
        "record",
        "record the stage again and name the file in plant.check, or for a plant from "
        "a file run python -m piezojax.validate",
    ),
    "response": (
        "response",
        "measure it again and compare both with python -m piezojax.identify --response",
    ),
}
"""What a second measurement is called, and how it is compared."""
