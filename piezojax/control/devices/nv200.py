"""Closed loop of the piezosystem jena NV200."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp

from ...core.arrays import Scalar, check_option, check_order
from ...core.parameter import parameter, rounded_fields, sample_time
from ...core.system import System
from ...dynamics.filters import KINDS, LowPass, Notch
from ...hardware import SlewLimit
from .servo_loop import (
    FIXED_DT,
    INTEGRATIONS,
    NO_SLEW,
    Device,
    ServoLoop,
    in_series,
    require_rate,
)

SLEW_OFF = 2000.0
"""Slew rate (%/ms) that switches the limit off."""


def _gain(unit: str, meaning: str):
    return parameter(
        unit,
        meaning,
        least=0.0,
        most=1e4,
        scale="log",
        typical=(1e-3, 1e4),
        step=1e-3,
        default=0.0,
    )


def _hertz(meaning: str, default: float, step: float = 1.0):
    return parameter(
        "Hz",
        meaning,
        least=1.0,
        most=9999.0,
        scale="log",
        typical=(10.0, 9999.0),
        step=step,
        default=default,
    )


def _switch(meaning: str):
    return parameter(
        "1",
        f"{meaning}: 1 is on",
        least=0.0,
        most=1.0,
        whole=True,
        static=True,
        default=0,
    )


class NV200(Device):
    """PID of the NV200 at 20 kHz, with the names and units of its commands.

    The setpoint passes a slew limit (``sr``, % of the range per ms; 2000 is off) and a
    low-pass of order 4 (``setlpf``), the measurement a low-pass of order 1
    (``poslpf``), and the command a notch (``notchf``, -3 dB width ``notchb``);
    ``setlpon``, ``poslpon`` and ``notchon`` switch these filters on. ``kp``, ``ki``,
    ``kd`` and the feedforwards ``pcf_x``, ``pcf_v``, ``pcf_a`` are the numbers that are
    typed in, with three decimals. The manual does not give their scale: ``scale`` is in
    V per um for a gain of 1, and ``device_scale`` measures it. If it is 0, the loop is
    assumed to normalise voltage and position by their ranges, and the scale is
    (avmax - avmin) / (posmax - posmin). Blocks, ranges and rounding are those of the
    vendor's manual and library (versions in docs/devices.md). The width of the notch is
    exact for a depth of 0 and a frequency far below 20 kHz; at 4 kHz the notch is 24 %
    narrower.

    Options that the manual does not specify: ``integration`` is "rectangular",
    "trapezoidal" or "half" (rectangular with half the gain, as the manual prints it);
    ``setpoint_filter`` is "butterworth" or "equal poles"; ``notch_depth`` is the gain
    at the centre of the notch; ``anti_windup`` is "none" or "hold".

    The analogue low-pass of the sensor (1.7 kHz) is part of the stage. Input an
    Observation, output in V. Raises ValueError for a value out of range.
    """

    kp: Scalar = _gain("1", "proportional gain")
    ki: Scalar = _gain("1/s", "integral gain")
    kd: Scalar = _gain("s", "derivative gain")
    avmin: Scalar = parameter("V", "minimum voltage", kw_only=True)
    avmax: Scalar = parameter("V", "maximum voltage", kw_only=True)
    posmin: Scalar = parameter("um", "minimum position", kw_only=True)
    posmax: Scalar = parameter("um", "maximum position", kw_only=True)
    pcf_x: Scalar = parameter(
        "1", "feedforward of the position", typical=(0.0, 1.0), step=1e-3, default=0.0
    )
    pcf_v: Scalar = parameter(
        "s", "feedforward of the velocity", step=1e-3, default=0.0
    )
    pcf_a: Scalar = parameter(
        "1e-6 s^2", "feedforward of the acceleration", step=1e-3, default=0.0
    )
    sr: Scalar = parameter(
        "%/ms", "slew rate", least=8e-7, most=SLEW_OFF, scale="log", default=SLEW_OFF
    )
    setlpf: Scalar = _hertz("low-pass of the setpoint", 200.0)
    poslpf: Scalar = _hertz("low-pass of the position", 1000.0, 1e-3)
    notchf: Scalar = _hertz("frequency of the notch", 1000.0)
    notchb: Scalar = _hertz("-3 dB width of the notch", 200.0)
    notch_depth: Scalar = parameter(
        "1", "gain at the centre of the notch", least=0.0, most=1.0, default=0.0
    )
    scale: Scalar = parameter(
        "V/um", "command for a gain of 1 and an error of 1 um", least=0.0, default=0.0
    )
    dt: float = sample_time(default=FIXED_DT)
    setlpon: int = _switch("low-pass of the setpoint")
    poslpon: int = _switch("low-pass of the position")
    notchon: int = _switch("notch")
    integration: str = eqx.field(static=True, default="rectangular")
    setpoint_filter: str = eqx.field(static=True, default="butterworth")
    anti_windup: str = eqx.field(static=True, default="none")

    def __check_init__(self):
        require_rate(self)
        check_order("avmin", self.avmin, "avmax", self.avmax)
        check_order("posmin", self.posmin, "posmax", self.posmax)
        check_order("notchb", self.notchb, "2 notchf", 2.0 * self.notchf, equal=True)
        check_option("integration", self.integration, (*INTEGRATIONS, "half"))
        check_option("setpoint_filter", self.setpoint_filter, KINDS)

    def typed(self) -> "NV200":
        """Return the device with its parameters rounded as they are typed in.

        Rounding could make the notch a hertz wider than its limit of 2 notchf.
        Therefore the width is first limited to 2 floor(notchf).
        """
        width = jnp.minimum(self.notchb, 2.0 * jnp.floor(self.notchf))
        return rounded_fields(dataclasses.replace(self, notchb=width))

    @property
    def _assumed_scale(self) -> Scalar:
        return (self.avmax - self.avmin) / (self.posmax - self.posmin)

    @property
    def cautions(self) -> tuple[str, ...]:
        """Caution that the scale is assumed, if it is."""
        if self.scale > 0.0:
            return ()
        return (
            f"the scale of the gains of the NV200 is assumed, "
            f"{float(self._assumed_scale):.4g} V/um: on the device the gains may act "
            "several times as strongly as simulated; measure it (python -m "
            "piezojax.identify RECORD --controller nv200) and set controller.scale",
        )

    def loop(self) -> ServoLoop:
        """Return the loop of the parameters, without rounding them."""
        scale = jnp.where(self.scale > 0.0, self.scale, self._assumed_scale)
        range = self.posmax - self.posmin
        half = self.integration == "half"
        rate = jnp.where(self.sr < SLEW_OFF, 10.0 * self.sr * range, NO_SLEW)
        low_pass: System | None = None
        if self.setlpon:
            low_pass = LowPass(self.setlpf, self.dt, 4, self.setpoint_filter)
        damping = 0.5 * self.notchb / self.notchf
        notch = Notch(self.notchf, damping, self.notch_depth, self.dt)
        return ServoLoop(
            in_series(SlewLimit(rate, self.dt), low_pass),
            LowPass(self.poslpf, self.dt) if self.poslpon else in_series(),
            notch if self.notchon else in_series(),
            scale * self.kp,
            scale * self.ki * (0.5 if half else 1.0),
            scale * self.kd,
            self.avmin,
            self.avmax,
            self.dt,
            scale * self.pcf_x,
            scale * self.pcf_v,
            scale * 1e-6 * self.pcf_a,
            integration="rectangular" if half else self.integration,
            anti_windup=self.anti_windup,
        )
