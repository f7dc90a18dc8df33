"""Tables of a study that describe the stage: plant, drive, sensor, disturbance."""

from pathlib import Path

import numpy as np
from pydantic import field_validator, model_validator

from ..identification import chain
from .tables import ByAxis, Finite, NotNegative, Positive, Table


class RecordPlant(Table):
    """A plant fitted to a record.

    ``time``, ``input`` and ``output`` are columns, by name or number; ``train`` is the
    first sample of the fitted part and the sample after its last. ``record_rate`` is
    the sampling rate of the record, Hz.
    """

    record: Path
    model: str
    time: str | int | None = None
    input: str | int = 0
    output: str | int = 1
    record_rate: Positive | None = None
    train: tuple[int, int] | None = None

    @field_validator("model")
    @classmethod
    def _known(cls, name: str) -> str:
        chain(name)
        return name


class Actuator(Table):
    """Drive: its limits ``lower`` and ``upper``, V, and optional properties.

    ``slew_rate`` is in V/s; ``resolution`` is that of the converter, V.
    """

    lower: ByAxis[Finite]
    upper: ByAxis[Finite]
    slew_rate: Positive | None = None
    resolution: Positive | None = None

    @model_validator(mode="after")
    def _ordered(self) -> "Actuator":
        if np.ndim(self.lower) != np.ndim(self.upper):
            raise ValueError("lower and upper must both be lists, or neither")
        pairs = zip(np.ravel(self.lower), np.ravel(self.upper), strict=False)
        for lower, upper in pairs:
            if lower >= upper:
                raise ValueError(
                    f"lower is {lower:g} V and upper {upper:g} V; "
                    "lower must be below upper"
                )
        return self


class SensorTable(Table):
    """Noise and resolution of the sensor, um."""

    noise_rms: ByAxis[NotNegative] = 0.0
    resolution: Positive | None = None


class DisturbanceTable(Table):
    """Disturbance of the displacement.

    ``drift_rms`` is the rms value of a random walk after one second, um.
    """

    drift_rms: ByAxis[NotNegative] = 0.0
