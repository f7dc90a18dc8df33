"""Tables of a study that describe the stage: axes, drive, sensor, disturbance."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from ..core.plain import shown
from .file_tables import NoiseFile
from .tables import (
    ByAxis,
    Finite,
    NotNegative,
    Positive,
    Table,
    example,
    in_unit,
    one_of,
)

Bandwidth = Annotated[float, Field(ge=1e-3, le=1e9, allow_inf_nan=False, strict=True)]
Order = Annotated[int, Field(strict=True, ge=1, le=4)]
LoopWidth = Annotated[float, Field(ge=0, lt=0.5, allow_inf_nan=False, strict=True)]

SIGNAL = "V, um or urad"
"""Unit of the signal behind the electronics."""


class ElectronicsTable(Table):
    """Electronics between the controller and the stage; each entry may be left out."""

    resolution: Annotated[ByAxis[Positive] | None, in_unit(SIGNAL)] = None
    """Step of the converter, unless ``bits`` gives it."""
    bits: Annotated[int, Field(strict=True, ge=1, le=32)] | None = None
    """Bits of the converter: its step is ``range`` divided by 2 to the power of
    ``bits``."""
    range: Annotated[ByAxis[Positive] | None, in_unit(SIGNAL)] = None
    """Range of the converter, with ``bits``."""
    bandwidth: Annotated[ByAxis[Bandwidth] | None, in_unit("Hz")] = None
    """Bandwidth of a Butterworth low-pass."""
    order: Order | None = None
    """Order of that low-pass; without this key 1."""
    delay: Annotated[ByAxis[NotNegative], in_unit("s")] = 0.0
    """Delay of the electronics."""

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
    """Drive: the limits of its voltage, and its amplifier.

    Without ``range`` the bits divide the interval from ``lower`` to ``upper``. The
    controller knows the voltage after the limits, the slew rate and the converter, but
    not the amplifier's bandwidth and delay behind them.
    """

    model_config = example({"lower": -20.0, "upper": 120.0, "bits": 16})

    lower: Annotated[ByAxis[Finite], in_unit("V")]
    """Lower limit of the voltage."""
    upper: Annotated[ByAxis[Finite], in_unit("V")]
    """Upper limit of the voltage, above ``lower``."""
    slew_rate: Annotated[ByAxis[Positive] | None, in_unit("V/s")] = None
    """Largest rate of the voltage."""
    current_limit: Annotated[ByAxis[Positive] | None, in_unit("A")] = None
    """Largest current; with ``capacitance`` it limits the slew rate too."""
    capacitance: Annotated[ByAxis[Positive] | None, in_unit("F")] = None
    """Capacitance of the stage."""
    computation: Annotated[NotNegative, in_unit("samples")] = 0.0
    """Delay from the sample of the sensor to the change of the voltage, in addition to
    ``delay``."""

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
    """Noise of the sensor, and its electronics."""

    model_config = example(
        {"noise_rms": 0.002, "bandwidth": 1700.0, "bits": 16, "range": 12.0}
    )

    noise_rms: Annotated[ByAxis[NotNegative], in_unit("um or urad")] = 0.0
    """Rms noise, white up to half the rate, added behind the bandwidth and the
    delay."""
    measured_noise: NoiseFile | None = None
    """Measured noise instead of ``noise_rms``."""
    anti_aliasing: Annotated[ByAxis[Bandwidth] | None, in_unit("Hz")] = None
    """Bandwidth of a low-pass that filters displacement and noise before the
    converter."""
    anti_aliasing_order: Order | None = None
    """Order of that low-pass; without this key 1."""

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
    """Disturbances of the stage."""

    model_config = example({"drift_rms": 0.005})

    drift_rms: Annotated[ByAxis[NotNegative], in_unit("um or urad")] = 0.0
    """Rms value, after one second, of a random walk that is added to the
    displacement."""
    hysteresis: LoopWidth | None = None
    """Width of the hysteresis loop that the plant lacks, over the span of all
    references and relative to its height. Its deviation from the plant is a
    disturbance. Without this key it is 0.15, which is typical of piezo ceramics, for a
    plant from a frequency response, and 0 for others."""
    output: NoiseFile | None = None
    """Measured vibration, added to the displacement; in um or urad, or a unit that is
    converted to it."""
    input: NoiseFile | None = None
    """Measured noise, added to the voltage of the actuator; in V, or a unit that is
    converted to it."""


class AxesTable(Table):
    """Names and units of the axes of a multi-axis stage."""

    model_config = example({"names": ["x", "y"], "units": ["um", "um"]})

    names: tuple[str, ...] = Field(min_length=2)
    """Names of the axes, of letters, digits and _; they differ in more than upper and
    lower case."""
    units: tuple[str, ...]
    """Unit of each axis, um or urad."""

    @model_validator(mode="after")
    def _consistent(self) -> "AxesTable":
        if len(self.units) != len(self.names) or len(set(self.names)) < len(self.names):
            raise ValueError("names must differ and have one unit each")
        if len({name.casefold() for name in self.names}) < len(self.names):
            raise ValueError(
                f"names are {', '.join(self.names)}; they must differ in more than "
                "upper and lower case, because files are named after them"
            )
        for unit in self.units:
            one_of(unit, ("um", "urad"))
        for name in self.names:
            if not name.isidentifier():
                raise ValueError(
                    f"axis {shown(name)}: a name consists of letters, digits and _"
                )
        return self
