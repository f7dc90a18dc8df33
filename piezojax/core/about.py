"""Origin of a saved System: the table ``about`` of its file."""

from collections.abc import Iterable
from importlib.metadata import version
from typing import Any

from pydantic import BaseModel, Field

from .error_bound import ErrorBound


def commented(lines: Iterable[str]) -> str:
    """Return ``lines`` as comments of a text file, each after ``#``."""
    return "".join(f"# {line}\n" for line in lines)


class About(BaseModel):
    """Origin of a saved System, and the reasons not to use it.

    ``piezojax`` is the version that wrote the file. ``study`` is the name of the study
    with its ``seed``, ``study_sha256`` the hash of the study and its files, ``record``
    the origin of the record of a fit, and ``rate_Hz`` the sampling rate. ``units`` maps
    the channels of the System to their units, and ``parameter_units`` its parameters,
    by path; "" is an unknown unit.
    ``input_ranges`` are the least and greatest value of each input in the record, and
    ``input_slews`` the greatest change of each in a second.
    ``judged`` lists the margins that a controller was judged with, a sentence each,
    and ``plants`` the ranges of the plants on which they hold.
    ``actuator`` is the actuator that a controller was tuned with, as in a file of a
    System. ``reference_ranges`` are the least and greatest value of its references on
    each axis. ``error_bound`` bounds the error of a fitted model, ``residual_rms`` is
    the rms error of each output on the validation part of its record, in the unit of
    the output, and ``checked`` lists the other records of its validation.
    ``standard_errors`` are the standard errors of its parameters, by path.
    ``small_motions`` tells that the model is fitted to small motions alone. ``unsafe``
    lists the alarms raised when the System was made; ``load`` refuses a file with any.
    Keys of later versions are ignored.
    """

    piezojax: str = Field(default_factory=lambda: version("piezojax"))
    study: str | None = None
    study_sha256: str | None = None
    seed: int | None = None
    record: str | None = None
    rate_Hz: float | None = None  # noqa: N815
    units: dict[str, str] = {}
    parameter_units: dict[str, str] = {}
    input_ranges: list[tuple[float, float]] = []
    input_slews: list[float] = []
    judged: list[str] = []
    plants: list[str] = []
    actuator: dict[str, Any] | None = None
    reference_ranges: list[tuple[float, float]] = []
    error_bound: ErrorBound | None = None
    residual_rms: list[float] = []
    checked: list[str] = []
    standard_errors: dict[str, float] = {}
    small_motions: bool = False
    unsafe: list[str] = []

    def origin(self, subject: str) -> list[str]:
        """Return the header lines of a file with ``subject``, the alarms first."""
        seed = "" if self.seed is None else f", seed {self.seed}"
        hashed = self.study_sha256
        rate = "" if not self.rate_Hz else f"{self.rate_Hz:.9g} Hz only"
        lines = [
            *(f"UNSAFE: {each}" for each in self.unsafe),
            f"{subject}, exported by piezojax {self.piezojax}.",
            *([f"Study: {self.study}{seed}."] if self.study else []),
            *([f"SHA-256 of the study: {hashed}."] if hashed else []),
            *([f"Record: {self.record}."] if self.record else []),
            *([f"Sampling rate: {rate}."] if rate else []),
            *(f"Judged: {each}." for each in self.judged),
            *([f"Plants: {'; '.join(self.plants)}."] if self.plants else []),
        ]
        return [line.replace("\n", " ") for line in lines]

    def require_safe(self, name: str, remedy: str) -> None:
        """Raise ValueError, ending in ``remedy``, if the System ``name`` is unsafe."""
        if self.unsafe:
            count = len(self.unsafe)
            alarms = "an alarm" if count == 1 else f"{count} alarms"
            reasons = "; ".join(self.unsafe)
            raise ValueError(f"{name} was written with {alarms}: {reasons}; {remedy}")
