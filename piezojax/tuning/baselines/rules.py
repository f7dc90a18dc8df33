"""Tuning rules that give a PID from the ultimate gain and period of a stage."""

from typing import NamedTuple

from ...control import PID
from ...core.arrays import check

FILTER = 8.0
"""Ratio of the derivative time to the time constant of the derivative's filter."""


class Ultimate(NamedTuple):
    """Gain (V/um) and period (s) at which a proportional loop just oscillates."""

    gain: float
    period: float


class Rule(NamedTuple):
    """Tuning rule: gain and times as shares of the ultimate gain and period."""

    gain: float
    integral: float
    derivative: float = 0.0

    def pid(self, ultimate: Ultimate, dt: float) -> PID:
        """Return the PID (um to V) for a sample time of ``dt`` s.

        The time constant of the anti-windup is the integral time. Raises ValueError for
        a gain or period that is not positive.
        """
        check("ultimate gain in V/um", ultimate.gain, above=0.0)
        check("ultimate period in s", ultimate.period, above=0.0)
        proportional = self.gain * ultimate.gain
        integral_time = self.integral * ultimate.period
        derivative_time = self.derivative * ultimate.period
        return PID(
            proportional=proportional,
            integral=proportional / integral_time,
            derivative=proportional * derivative_time,
            derivative_filter=derivative_time / FILTER,
            anti_windup=1.0 / integral_time,
            dt=dt,
        )


ZIEGLER_NICHOLS = {
    "PI": Rule(gain=0.45, integral=1.0 / 1.2),
    "PID": Rule(gain=0.6, integral=0.5, derivative=0.125),
}
"""Rules of Ziegler and Nichols (1942): each swing has a quarter of the amplitude of the
one before."""

TYREUS_LUYBEN = {
    "PI": Rule(gain=1.0 / 3.2, integral=2.2),
    "PID": Rule(gain=1.0 / 2.2, integral=2.2, derivative=1.0 / 6.3),
}
"""Rules of Tyreus and Luyben (1992): slower, with more damping, for integrating
stages."""
