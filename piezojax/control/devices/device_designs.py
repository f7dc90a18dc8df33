"""Initial parameters of vendors' controllers: stable, slow loops with a notch."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from ...core.parameter import declarations
from ...core.system import Affine, System, rest_output
from ...dynamics.plant_modes import plant_modes
from ..design_model import CROSSOVER, DesignModel, design_model
from .e727 import E727, HIGHEST, UNKNOWN
from .nv200 import NV200, SLEW_OFF
from .servo_loop import NO_SLEW

D = TypeVar("D", bound=System)
Limits = tuple[float, float]


class Start(NamedTuple):
    """Parameters of a slow loop with a PI and one notch.

    ``proportional`` is in V/um and ``integral`` in V/(um s); ``notch`` is the frequency
    of the plant's strongest mode in Hz, or a quarter of the sampling rate if it has
    none.
    """

    proportional: float
    integral: float
    notch: float


def nv200(
    plant: System,
    dt: float,
    limits: Limits,
    *,
    scale: float = 0.0,
    slew: float | None = None,
    range: Limits | None = None,
) -> NV200:
    """Return an NV200 whose integral and notch suit the plant between ``limits`` (V).

    ``scale`` (V/um) is that of the device; 0 stands for the assumed one. ``slew`` um/s
    limits the setpoint, and ``range`` (um) are the ends of the device's range, by
    default the displacements at the limits. ``dt`` in s. Raises ValueError for a plant
    without positive gain, for another rate than 20 kHz, and in the cases of
    ``design_model`` and ``DesignModel.fastest_stable``.
    """
    model = _rising(plant, dt, limits)
    lowest, highest = range or (float(rest_output(plant, end)) for end in limits)
    volts = scale or (limits[1] - limits[0]) / (highest - lowest)
    percent = SLEW_OFF if slew is None else 0.1 * slew / (highest - lowest)

    def device(start: Start) -> NV200:
        return NV200(
            kp=_within_range("kp", start.proportional / volts),
            ki=_within_range("ki", start.integral / volts),
            avmin=limits[0],
            avmax=limits[1],
            posmin=lowest,
            posmax=highest,
            sr=min(percent, SLEW_OFF),
            notchf=start.notch,
            notchb=0.25 * start.notch,
            scale=scale,
            dt=dt,
            notchon=1,
        )

    return _designed(model, plant, device)


def _within_range(name: str, gain: float) -> float:
    """Return ``gain``, clipped to the declared range of the NV200's gain ``name``."""
    declared = dict(declarations(NV200))[name].typical
    assert declared is not None
    return float(np.clip(gain, *declared))


def e727(
    plant: System,
    dt: float,
    limits: Limits,
    *,
    scale: float,
    structure: str = UNKNOWN,
    slew: float | None = None,
) -> E727:
    """Return an E-727 whose integral and notch suit the plant between ``limits`` (V).

    The notch lies at the plant's strongest mode, but not above 9 kHz, the limit of the
    device.
    ``scale`` (V/um) and ``structure`` are those of the device; ``slew`` um/s limits the
    setpoint, and ``dt`` is in s. Raises ValueError as ``nv200`` and for an unknown
    ``structure``.
    """
    model = _rising(plant, dt, limits)

    def device(start: Start) -> E727:
        outer = scale if structure == "parallel" else start.proportional
        return E727(
            proportional=start.proportional / scale,
            integral_time=outer / start.integral,
            scale=scale,
            lower=limits[0],
            upper=limits[1],
            notch_frequency_1=min(start.notch, HIGHEST),
            notch_rejection_1=0.1,
            slew_rate=NO_SLEW if slew is None else slew,
            dt=dt,
            structure=structure,
        )

    return _designed(model, plant, device)


def _rising(plant: System, dt: float, limits: Limits) -> DesignModel:
    model = design_model(plant, dt, limits)
    model.check_rising("the gains of the device are positive")
    return model


def _designed(model: DesignModel, plant: System, device: Callable[[Start], D]) -> D:
    gain = float(model.total_gain())
    middle = rest_output(plant, 0.5 * sum(model.limits))
    modes = plant_modes(plant, middle, model.dt)
    strongest = max(modes, key=lambda mode: mode.gain, default=None)
    notch = strongest.frequency if strongest else 0.25 / model.dt

    def paced(pace: float) -> D:
        integral = CROSSOVER * pace / (gain * model.dt)
        return device(Start(0.5 * integral * model.dt, integral, notch))

    return model.fastest_stable(paced, Affine(model.gain()))


DEVICE_DESIGNS: dict[str, Callable[..., System]] = {"nv200": nv200, "e727": e727}
"""Designs of devices by the name that a study uses."""
