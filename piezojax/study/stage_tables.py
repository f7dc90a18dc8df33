"""The tables of a study that describe its stage: plant, drive, sensor, disturbance."""

from pathlib import Path

import numpy as np
from pydantic import field_validator, model_validator

from ..identification import chain
from .tables import ByAxis, Finite, NotNegative, Positive, Table


class RecordPlant(Table):
    """A plant fitted to a record: columns by name or number, parts in samples."""

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
    """Limits of the drive, V and V/s; ``resolution`` of its converter, V."""

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
    """What moves the stage beside the drive: ``drift_rms``, a random walk, um rms after
    one second.
    """

    drift_rms: ByAxis[NotNegative] = 0.0
