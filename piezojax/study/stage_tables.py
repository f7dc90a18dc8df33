"""Tables of a study that describe the stage: plant, drive, sensor, disturbance."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from .file_tables import NoiseFile
from .tables import ByAxis, Finite, NotNegative, Positive, Table

Bandwidth = Annotated[float, Field(ge=1e-3, le=1e9, allow_inf_nan=False, strict=True)]
Order = Annotated[int, Field(strict=True, ge=1, le=4)]


class ElectronicsTable(Table):
    """Electronics between the controller and the stage; each entry may be left out.

    The step of the converter is ``resolution``, or its ``range`` divided by 2 to the
    power of ``bits``; ``resolution`` and ``range`` are in the unit of the signal.
    ``bandwidth`` (Hz) and ``order`` (1 to 4) are those of a Butterworth low-pass,
    ``delay`` is in s.
    """

    resolution: ByAxis[Positive] | None = None
    bits: Annotated[int, Field(strict=True, ge=1, le=32)] | None = None
    range: ByAxis[Positive] | None = None
    bandwidth: ByAxis[Bandwidth] | None = None
    order: Order | None = None
    delay: ByAxis[NotNegative] = 0.0

    @model_validator(mode="after")
    def _converter(self) -> "ElectronicsTable":
        if self.resolution is not None and self.bits is not None:
            raise ValueError("resolution and bits are both given; give one of them")
        _needs(self, "range", "bits")
        _needs(self, "order", "bandwidth")
        return self


def _needs(table: Table, key: str, other: str) -> None:
    """Raise ValueError if ``table`` has ``key`` without ``other``."""
    if getattr(table, key) is not None and getattr(table, other) is None:
        raise ValueError(f"{key} is given without {other}; give both or neither")


class Actuator(ElectronicsTable):
    """Drive: its limits ``lower`` and ``upper``, V, and the rest of its amplifier.

    ``slew_rate`` is in V/s. ``current_limit`` (A) and ``capacitance`` of the stage (F)
    limit the slew rate too. ``computation`` is the time from the sample of the sensor
    to the change of the voltage, in samples. Without ``range`` the bits divide the
    interval from ``lower`` to ``upper``.

    The controller knows the voltage after the limits, the slew rate and the converter,
    but not the amplifier's bandwidth and delay behind them.
    """

    lower: ByAxis[Finite]
    upper: ByAxis[Finite]
    slew_rate: ByAxis[Positive] | None = None
    current_limit: ByAxis[Positive] | None = None
    capacitance: ByAxis[Positive] | None = None
    computation: NotNegative = 0.0

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
        if self.current_limit is not None and self.capacitance is None:
            raise ValueError(
                "current_limit is given without capacitance; "
                "the slew rate is the current over the capacitance of the stage"
            )
        return self


class SensorTable(ElectronicsTable):
    """Noise of the sensor, um, and the properties of its electronics.

    ``noise_rms`` is white up to half the rate and is added behind the bandwidth and the
    delay; ``measured_noise`` replaces it by the noise of a file. ``anti_aliasing``
    (Hz), of order ``anti_aliasing_order``, filters the displacement and the noise
    before the converter.
    """

    noise_rms: ByAxis[NotNegative] = 0.0
    measured_noise: NoiseFile | None = None
    anti_aliasing: ByAxis[Bandwidth] | None = None
    anti_aliasing_order: Order | None = None

    @model_validator(mode="after")
    def _measured(self) -> "SensorTable":
        if self.bits is not None and self.range is None:
            raise ValueError("bits is given without range, the travel that it divides")
        _needs(self, "anti_aliasing_order", "anti_aliasing")
        if self.measured_noise is not None and np.any(np.greater(self.noise_rms, 0.0)):
            raise ValueError(
                "noise_rms and measured_noise are both given; give one of them"
            )
        return self


class DisturbanceTable(Table):
    """Disturbances of the stage.

    ``drift_rms`` is the rms value of a random walk after one second, um. ``output`` is
    a measured vibration that is added to the displacement, in the unit of each axis;
    ``input`` is measured noise that is added to the voltage of the actuator, V.
    """

    drift_rms: ByAxis[NotNegative] = 0.0
    output: NoiseFile | None = None
    input: NoiseFile | None = None
