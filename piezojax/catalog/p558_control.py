"""Controllers of the P-558.TCD with the printed gains of chapters 7 and 8, at 500 Hz.

Every number carries its table or section in Y. Cao's thesis (2013). Commands and
outputs are in um, urad, urad.
"""

import math
from typing import Any

from ..control.alpha_beta import AlphaBeta
from ..control.anticipation import Anticipation
from ..control.disturbance_observer import DisturbanceObserverControl
from ..control.filtered import Filtered
from ..control.multi_axis import MultiAxisSlidingMode
from ..control.nominal import NominalSlidingMode
from ..control.pid import PID
from ..control.state_sliding_mode import StateSlidingMode
from ..control.switching import SwitchingPID
from ..core.axes import PerAxis
from ..core.feedback import Feedback
from ..core.system import System
from ..dynamics import ARMA, Channels, SecondOrderLag, channels_of, observability_form
from ..hardware import Saturation, Sensor
from . import p558
from .p558 import DT, NOISE_RMS, OUTPUTS

PID_GAINS = ((1.5, 2.0, 2.0), (120.0, 90.0, 100.0), (0.0, 0.0, 0.0))
"""Table 7-3: P, I in 1/s and D in s by axis."""

FILTER = {"alpha": 0.5, "beta": 0.002}
"""Alpha-beta filter, by trial and error: sections 7.5.4.2 and 8.5.4.2."""

SURFACE = -0.7
"""m of section 7.5.4.2: S = [m^2 I, 2 m I, I], the state errors' double pole at -m."""

REACHING = (0.9, 0.5, 0.4)
"""Diagonal of PHI, section 7.5.4.2."""

DECOUPLING = ((-0.3, 0.0, 0.0), (-0.007, -0.2, 0.0), (0.01, 0.0, -0.3))
"""K_s1, section 7.5.4.2 (third element printed as K_s111 again)."""

MULTI_AXIS_GAINS = {
    "step": {
        "proportional": (1.0, 4.0, 2.0),
        "integral": (60.0, 500.0, 200.0),
        "frequency": 200.0,
    },
    "dynamic": {
        "proportional": (6.0, 2.0, 3.0),
        "integral": (300.0, 50.0, 30.0),
        "frequency": 1000.0,
    },
}
"""Diagonals of P and I in 1/s (D = 0), and w_n of the reference model in rad/s with a
damping of 0.9: sections 7.5.4.2 and 7.5.4.3."""

DAMPING = 0.9

STATE_WEIGHTS = {"effort_weight": 1.0, "process": 1.0, "drift": 0.1}
"""Ours, without unit on this stage."""

ARX = (
    ((1.699, -0.7394), (-0.004917, 0.04512)),
    ((1.796, -0.8122), (-0.001969, 0.03962)),
    ((1.832, -0.847), (-0.001185, 0.02997)),
)
"""(8.40)-(8.42): coefficients of y(k-1), y(k-2) and u(k-1), u(k-2) by axis."""

REPAIRS = (1.043, 0.404, 0.491)
"""Factors on the numerators of (8.40)-(8.42) that give the DC gains of (7.53); the
printed models have 0.995, 2.32 and 1.92. With the printed Rx and Ry models neither
Table 8-2 nor Table 8-3 is reproduced; with the printed Z model the observer increases
the error at 5 Hz."""

ARX_MODELS = ("repaired", "printed")

NOMINAL_GAINS = {
    "nominal": {
        "proportional": (0.1, 0.2, 0.05),
        "integral": (0.6, 0.3, 10.0),
        "control_weight": (0.1, 0.05, 0.05),
    },
    "disturbance_observer": {
        "proportional": (0.3, 0.1, 0.05),
        "integral": (0.5, 0.3, 0.1),
        "control_weight": (0.1, 0.05, 0.05),
    },
}
"""Table 8-1; D = 0 and Q = 1 throughout."""

NOMINAL_SURFACE = 0.2
"""S = [0.2, 1] of section 8.5.4.2."""

CUTOFF_HZ = 30.0
"""Cut-off of the Q-filters in Hz, section 8.5.4.2."""

LIMITS = ((0.0, 50.0), (-250.0, 250.0), (-250.0, 250.0))
"""Travel of the stage in um and urad: data of the manufacturer (Table 6-1)."""


def pid() -> System:
    """Return a PID on each axis, Table 7-3."""
    p, i, d = PID_GAINS
    parts = tuple(PID(*gains, dt=DT) for gains in zip(p, i, d, strict=True))
    return PerAxis(parts, OUTPUTS)


def multi_axis(gains: str = "dynamic", filtered: bool = True) -> System:
    """Return the PID-based sliding mode control of chapter 7.

    ``gains`` is "step" or "dynamic"; ``filtered`` adds the alpha-beta filters. Raises
    ValueError for other gains.
    """
    chosen = _one_of(MULTI_AXIS_GAINS, gains)
    scale = (SURFACE**2, 2.0 * SURFACE, 1.0)
    law = SwitchingPID(
        chosen["proportional"],
        chosen["integral"],
        (0.0, 0.0, 0.0),
        dt=DT,
    )
    controller = MultiAxisSlidingMode(
        law,
        reaching=REACHING,
        decoupling=DECOUPLING,
        surface=tuple((s, s, s) for s in scale),
        model=observability_form(p558.model("7")),
        reference_model=PerAxis(
            tuple(SecondOrderLag(chosen["frequency"], DAMPING, DT) for _ in OUTPUTS),
            OUTPUTS,
        ),
    )
    if not filtered:
        return controller
    parts = tuple(AlphaBeta(**FILTER, dt=DT) for _ in OUTPUTS)
    return Filtered(PerAxis(parts, OUTPUTS), controller)


def state_sliding_mode() -> System:
    """Return state-tracking control on the model (7.53); weights ours.

    Reaching gain and reference model are those of ``multi_axis``.
    """
    none = (0.0, 0.0, 0.0)
    frequency = MULTI_AXIS_GAINS["dynamic"]["frequency"]
    lags = tuple(SecondOrderLag(frequency, DAMPING, DT) for _ in OUTPUTS)
    return StateSlidingMode(
        SwitchingPID(none, none, none, dt=DT),
        p558.model("7"),
        PerAxis(lags, OUTPUTS),
        reaching=REACHING,
        **STATE_WEIGHTS,
    )


def anticipating_state_sliding_mode() -> System:
    """Return ``state_sliding_mode`` in an Anticipation of lead 0 (ours)."""
    return Anticipation(state_sliding_mode(), (0.0, 0.0, 0.0))


def anticipating_multi_axis() -> System:
    """Return ``multi_axis`` in an Anticipation of lead 0 (ours), for tuning."""
    return Anticipation(multi_axis(), (0.0, 0.0, 0.0))


def anticipating_disturbance_observer() -> System:
    """Return ``disturbance_observer`` in an Anticipation of lead 0 (ours)."""
    return Anticipation(disturbance_observer(), (0.0, 0.0, 0.0))


def nominal(arx: str = "repaired", filtered: bool = True, **options: Any) -> System:
    """Return a nominal PID-based sliding mode control on each axis, Table 8-1.

    ``arx`` is "repaired" or "printed"; ``options`` are those of ``NominalSlidingMode``.
    """
    return _per_axis("nominal", arx, filtered, options)


def disturbance_observer(
    arx: str = "repaired", filtered: bool = True, **options: Any
) -> System:
    """Return a nominal controller and disturbance observer on each axis, Table 8-1.

    Arguments as for ``nominal``.
    """
    return _per_axis(
        "disturbance_observer", arx, filtered, {"correction": 1.0} | options
    )


def _per_axis(name: str, arx: str, filtered: bool, options: dict[str, Any]) -> System:
    gains = NOMINAL_GAINS[name]
    parts = []
    for axis, model in enumerate(arx_models(arx)):
        law = SwitchingPID(
            gains["proportional"][axis], gains["integral"][axis], 0.0, dt=DT
        )
        part: System = NominalSlidingMode(
            law,
            control_weight=gains["control_weight"][axis],
            surface=NOMINAL_SURFACE,
            error_weight=1.0,
            model=model,
            **options,
        )
        if name == "disturbance_observer":
            cutoff = 2.0 * math.pi * CUTOFF_HZ
            part = DisturbanceObserverControl(part, model, 1.0, cutoff, DT)
        parts.append(Filtered(AlphaBeta(**FILTER, dt=DT), part) if filtered else part)
    return PerAxis(tuple(parts), OUTPUTS)


def arx_models(name: str = "repaired") -> tuple[ARMA, ...]:
    """Return the nominal models of the three axes, "repaired" or "printed".

    Raises ValueError for another name.
    """
    if name not in ARX_MODELS:
        raise ValueError(f"ARX model {name!r}; it must be one of {list(ARX_MODELS)}")
    factors = REPAIRS if name == "repaired" else (1.0, 1.0, 1.0)
    return tuple(
        ARMA(a, (factor * b[0], factor * b[1], 0.0))
        for (a, b), factor in zip(ARX, factors, strict=True)
    )


def stage(chapter: str = "7") -> Channels:
    """Return the printed model as the plant of a loop, (7.53) or (6.23)-(6.25)."""
    return channels_of(p558.channels(chapter))


def loop(
    controller: System,
    noise_rms: tuple[float, float, float] = NOISE_RMS,
    plant: System | None = None,
) -> Feedback:
    """Return a loop of ``controller`` and ``plant``, by default (7.53).

    Commands are limited to +-1e4, far beyond the travel. ``noise_rms`` in um, urad,
    urad.
    """
    wide = PerAxis(tuple(Saturation(-1e4, 1e4) for _ in OUTPUTS), OUTPUTS)
    sensor = PerAxis(tuple(Sensor(rms) for rms in noise_rms), OUTPUTS)
    return Feedback(controller, plant or stage(), wide, sensor)


def _one_of(table: dict[str, Any], name: str) -> Any:
    if name not in table:
        raise ValueError(f"gains {name!r}; they must be one of {list(table)}")
    return table[name]
