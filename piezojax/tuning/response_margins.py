"""Margins of the tuned loop on the measured frequency response of its plant."""

from collections.abc import Iterator, Mapping

from ..analysis.stability import StabilityReports
from ..analysis.stability.measured_margins import MeasuredMargins, measured_margins
from ..study import Case
from .alarms import exact_figures
from .model_alarms import SLACK

FIGURES = {
    "sensitivity_peak": ("sensitivity_peak", "Ms", "", 1.0),
    "gain_margin": ("gain_margin_dB", "the gain margin", " dB", -1.0),
    "phase_margin": ("phase_margin_deg", "the phase margin", " degrees", -1.0),
    "delay_margin": ("delay_margin_samples", "the delay margin", " samples", -1.0),
    "disk_margin": ("disk_margin", "the disk margin", "", -1.0),
}
"""Limits by name: field of MeasuredMargins, words, unit; 1 for at most, -1 for at
least."""


def margins_on_response(
    case: Case, stability: StabilityReports
) -> dict[str, MeasuredMargins]:
    """Return the margins of the loops "before" and "after" on the measured response.

    Empty for a plant that was not fitted to a frequency response in this study; a loop
    that is unstable with the model is left out. The plant is linear: both branches are
    the same.
    """
    if case.response is None:
        return {}
    measured = case.response.response
    ratio = measured.values / case.response.fit.fitted
    return {
        name: measured_margins(next(iter(branches.values())), measured.frequency, ratio)
        for name, branches in stability.loops.items()
        if all(report.stable for report in stability.reports[name].values())
    }


def response_alarms(
    found: Mapping[str, MeasuredMargins],
    limits: Mapping[str, float],
    stability: StabilityReports,
) -> Iterator[str]:
    """Yield alarms for limits that hold on the model and not on the measured response.

    A relative excess up to SLACK does not count, because the response has noise.
    """
    after = found.get("after")
    if after is None:
        return
    if not after.stable:
        yield (
            "on the measured response the tuned loop is unstable, on its model it is "
            "stable: fit the response again with finer lines where it is steep, or "
            "lower constraints.sensitivity_peak"
        )
        return
    nominal = [one for one in exact_figures(stability).values() if one is not None]
    for name, (field, words, unit, sense) in FIGURES.items():
        limit, value = limits.get(name), getattr(after, field)
        if limit is None or value is None:
            continue
        known = [one.get(name) for one in nominal]
        of_model = [one for one in known if one is not None]
        allowed = sense * limit + SLACK * abs(limit)
        if sense * value <= allowed or any(sense * m > allowed for m in of_model):
            continue
        at = f" at {after.sensitivity_peak_Hz:.4g} Hz" if sense > 0.0 else ""
        model = f"; {of_model[0]:.3g} on the model" if of_model else ""
        yield (
            f"on the measured response {words} is {value:.3g}{unit}{at} (limit "
            f"{limit:g}{model}): tighten constraints.{name}, or fit a better model"
        )
