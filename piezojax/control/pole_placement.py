"""Switching PID by pole placement of the sliding variable (4.16)-(4.18)."""

from ..core.arrays import Scalar, Signal, State, as_scalars
from ..core.parameter import parameter, sample_time
from .anti_windup import anti_windup
from .switching import SwitchingLaw, SwitchingPID, SwitchingPIDState


class PlacedPID(SwitchingLaw):
    """``SwitchingPID`` whose gains follow from three ``poles`` of s, (4.18) corrected.

    With the equivalent control the sliding variable obeys s(k+1) = ``drive`` v(k)
    (4.12). The PID gives it the characteristic polynomial
    ``(z - p_1)(z - p_2)(z - p_3) = z^3 + g_2 z^2 + g_1 z + g_0``, hence
    D = g_0 dt / drive, P = -(g_1 + 2 g_0) / drive and
    I = (1 + g_2 + g_1 + g_0) / (drive dt). Poles (p, 0, 0) give an integral law, whose
    s decays by the factor p per sample; a pole of 1 removes the integral. ``drive`` is
    S B_d of the controller, times the gain of its inversion at rest where the weight R
    is not 0; the placement is exact only for R = 0.

    Raises ValueError unless there are three poles, all above -1 and at most 1.
    """

    poles: tuple[Scalar, ...] = parameter(
        "1",
        "poles of the sliding variable, real",
        above=-1.0,
        most=1.0,
        typical=(-0.5, 0.9999),
        converter=as_scalars,
    )
    drive: Scalar = parameter(
        "[s]/[v]",
        "change of s by v in one sample",
        above=0.0,
        scale="log",
        typical=(1e-3, 1e3),
    )
    dt: float = sample_time()
    anti_windup: Scalar = anti_windup()

    def __check_init__(self):
        if len(self.poles) != 3:
            raise ValueError(f"poles holds {len(self.poles)} numbers; it must hold 3")

    def placed(self) -> SwitchingPID:
        """Return the PID with its gains computed."""
        p1, p2, p3 = self.poles
        g1, g0 = p1 * p2 + p2 * p3 + p3 * p1, -p1 * p2 * p3
        # 1 + g2 + g1 + g0 loses all digits for poles near 1.
        left = (1.0 - p1) * (1.0 - p2) * (1.0 - p3)
        return SwitchingPID(
            -(g1 + 2.0 * g0) / self.drive,
            left / (self.drive * self.dt),
            g0 * self.dt / self.drive,
            self.dt,
            self.anti_windup,
        )

    def start(self, sliding: Signal, output: Signal) -> SwitchingPIDState:
        return self.placed().start(sliding, output)

    def driven(self, state: State, shortfall: Signal) -> SwitchingPIDState:
        return self.placed().driven(state, shortfall)

    def step(self, state: State, input: Signal) -> tuple[SwitchingPIDState, Signal]:
        return self.placed().step(state, input)
