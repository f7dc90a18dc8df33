"""Origin of a saved System: the table ``about`` of its file."""

from importlib.metadata import version
from typing import Any

from pydantic import BaseModel, Field

from .error_bound import ErrorBound


class About(BaseModel):
    """Origin of a saved System, and the reasons not to use it.

    ``piezojax`` is the version that wrote the file. ``study`` is the name of the study
    with its ``seed``, ``record`` the origin of the record of a fit, and ``rate_Hz`` the
    sampling rate. ``units`` maps the channels of the System to their units, and
    ``parameter_units`` its parameters, by path; "" is an unknown unit.
    ``input_ranges`` are the least and greatest value of each input in the record.
    ``judged`` lists the margins that a controller was judged with, a sentence each.
    ``actuator`` is the actuator that a controller was tuned with, as in a file of a
    System, ``reference_ranges`` the least and greatest of its references on each axis.
    ``error_bound`` bounds the error of a fitted model, ``residual_rms`` is the rms
    error of each output on the validation part of its record, in the unit of the
    output, and ``checked`` lists the other records of its validation;
    ``standard_errors`` are those of its parameters, by path. ``unsafe`` lists the
    alarms raised when the System was made; ``load`` refuses a file with any. Keys of
    later versions are ignored.
    """

    piezojax: str = Field(default_factory=lambda: version("piezojax"))
    study: str | None = None
    seed: int | None = None
    record: str | None = None
    rate_Hz: float | None = None  # noqa: N815
    units: dict[str, str] = {}
    parameter_units: dict[str, str] = {}
    input_ranges: list[tuple[float, float]] = []
    judged: list[str] = []
    actuator: dict[str, Any] | None = None
    reference_ranges: list[tuple[float, float]] = []
    error_bound: ErrorBound | None = None
    residual_rms: list[float] = []
    checked: list[str] = []
    standard_errors: dict[str, float] = {}
    unsafe: list[str] = []

    def require_safe(self, name: str, remedy: str) -> None:
        """Raise ValueError, ending in ``remedy``, if the System ``name`` is unsafe."""
        if self.unsafe:
            count = len(self.unsafe)
            alarms = "an alarm" if count == 1 else f"{count} alarms"
            reasons = "; ".join(self.unsafe)
            raise ValueError(f"{name} was written with {alarms}: {reasons}; {remedy}")
