"""Figure 4.10: tracking error against sampling rate, with the printed gains."""

from typing import NamedTuple

from ..catalog import p753_chapter4
from .chapter4 import COLUMNS, rms_errors
from .summary import comma_separated

FIGURE = "figure-4-10"

SIGNALS = ("SIN1", "SIN10", "SIN30", "SIN50")
"""Sinusoids of the simulated figure; those of the printed figure are not specified."""

RATES = {
    "model_reference": tuple(p753_chapter4.MODEL_REFERENCE_GAINS["4-4"]),
    "continuous": tuple(p753_chapter4.CONTINUOUS_GAINS),
}
"""Rates (Hz) with printed gains, by column."""


class RateError(NamedTuple):
    """RMS error (um) of a controller on a signal at a sampling rate (Hz)."""

    rate: int
    column: str
    row: str
    error: float


def errors_by_rate(signals: tuple[str, ...] = SIGNALS) -> list[RateError]:
    """Return the errors of both columns at each rate with printed gains.

    The thesis is read as for Tables 4-5 and 4-6. The numbers of the figure are not
    printed. According to the text, the model-reference controller is better, and its
    advantage grows towards low rates.
    """
    return [
        RateError(rate, column, row, error)
        for column, rates in RATES.items()
        for rate in sorted(rates)
        for row, error in rms_errors(COLUMNS["4-5"][column], signals, rate).items()
    ]


def rates_as_csv(errors: list[RateError]) -> str:
    """Return ``errors`` as comma-separated text with a header."""
    return comma_separated(
        ["rate_Hz", "column", "row", "sim_um"],
        [(e.rate, e.column, e.row, f"{e.error:.6g}") for e in errors],
    )
