"""First controllers for an identified plant: stable and slow, for tuning to improve."""

from collections.abc import Callable

from ..core.system import Series, System
from ..dynamics import ARMA, FirstOrderLag
from ..hysteresis import ColemanHodgdon, InverseColemanHodgdon
from .alpha_beta import AlphaBeta
from .disturbance_observer import DisturbanceObserverControl
from .inversion import InversionControl
from .pid import PID
from .sliding_mode import SlidingMode
from .switching import SwitchingPID


def _part(plant: System, kind: type[System]) -> System:
    parts = plant.parts if isinstance(plant, Series) else (plant,)
    for part in parts:
        if isinstance(part, kind):
            return part
    raise ValueError(
        f"this design needs a plant with a {kind.__name__}; it has "
        f"{', '.join(type(part).__name__ for part in parts)}"
    )


def _model(plant: System) -> ARMA:
    lag = _part(plant, FirstOrderLag)
    assert isinstance(lag, FirstOrderLag)
    return lag.as_arma()


def _hysteresis(plant: System) -> ColemanHodgdon:
    hysteresis = _part(plant, ColemanHodgdon)
    assert isinstance(hysteresis, ColemanHodgdon)
    return hysteresis


def _sliding_mode(plant: System, dt: float) -> SlidingMode:
    # Scaled from the printed P-753 set, whose surface is 0.9 / dt: the loop then
    # crosses over near 0.1 / dt whatever the rate.
    surface, weight = 0.5 / dt, 100.0
    return SlidingMode(
        SwitchingPID(1e-3, 0.1 * weight / (dt * surface), 1e-3 * dt, dt=dt),
        surface=surface,
        error_weight=1.0,
        control_weight=weight,
        model=_model(plant),
        filter=AlphaBeta(0.3, 1e-3, dt),
    )


def inversion_sliding_mode(plant: System, dt: float) -> InversionControl:
    """Return an inversion-based PID-SMC for a plant of hysteresis and lag."""
    return InversionControl(
        _sliding_mode(plant, dt), InverseColemanHodgdon(_hysteresis(plant))
    )


def disturbance_observer_sliding_mode(
    plant: System, dt: float
) -> DisturbanceObserverControl:
    """Return a DOB-based PID-SMC for a plant of hysteresis and lag."""
    hysteresis = _hysteresis(plant)
    gain = -hysteresis.a / hysteresis.c  # slope of the axis of the loop
    return DisturbanceObserverControl(
        _sliding_mode(plant, dt), _model(plant), gain, 0.05 / dt, dt
    )


def inversion_pid(plant: System, dt: float) -> InversionControl:
    """Return an integral-dominated PID behind the plant's inverse hysteresis."""
    pid = PID(0.05, 0.05 / dt, 1e-3 * dt, dt, 0.1 / dt, dt=dt)
    return InversionControl(pid, InverseColemanHodgdon(_hysteresis(plant)))


DESIGNS: dict[str, Callable[[System, float], System]] = {
    "inversion_sliding_mode": inversion_sliding_mode,
    "disturbance_observer_sliding_mode": disturbance_observer_sliding_mode,
    "inversion_pid": inversion_pid,
}
"""Designs by the name a study uses."""
