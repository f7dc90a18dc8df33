"""Initial controllers for tuning: stable, slow designs for an identified plant.

A design is a function of a plant, the sample time of the loop in s and the limits of
the actuator in V. Studies select it by its name in ``DESIGNS``. Each design is based on
the ``design_model`` of the plant.
"""

from collections.abc import Callable

from ..core.system import Affine, System
from ..dynamics import ARMA, scaled_to_dc
from .alpha_beta import AlphaBeta
from .design_model import CROSSOVER, design_model
from .disturbance_observer import DisturbanceObserverControl
from .inversion import InversionControl
from .pid import PID
from .sliding_mode import SlidingMode
from .switching import SwitchingPID

Limits = tuple[float, float]


def inversion_sliding_mode(
    plant: System, dt: float, limits: Limits
) -> InversionControl:
    """Return an inversion-based sliding mode controller with a PID law (PID-SMC).

    ``dt`` in s. Raises ValueError if the hysteresis has no inverse between ``limits``
    (V), and in the cases of ``design_model`` and ``DesignModel.fastest_stable``.
    """
    model = design_model(plant, dt, limits)
    inverse = model.inverse()
    feedback = model.fastest_stable(
        lambda pace: _sliding_mode(model.dynamics, dt, pace)
    )
    return InversionControl(feedback, inverse)


def disturbance_observer_sliding_mode(
    plant: System, dt: float, limits: Limits
) -> DisturbanceObserverControl:
    """Return a PID-SMC with a disturbance observer (DOB).

    The observer has the mean gain of the plant between ``limits`` (V); ``dt`` in s.
    Raises ValueError if this gain is not positive, and in the cases of ``design_model``
    and ``DesignModel.fastest_stable``.
    """
    model = design_model(plant, dt, limits)
    # The observer holds the whole gain from V to um; the model has unit gain.
    dynamics = scaled_to_dc(model.dynamics, 1.0)
    model.check_rising("the disturbance observer needs a gain above 0")
    gain = model.total_gain()

    def observed(pace: float) -> DisturbanceObserverControl:
        return DisturbanceObserverControl(
            _sliding_mode(dynamics, dt, pace),
            dynamics,
            gain,
            0.5 * CROSSOVER * pace / dt,
            dt,
        )

    return model.fastest_stable(observed, Affine(model.gain()))


def inversion_pid(plant: System, dt: float, limits: Limits) -> InversionControl:
    """Return an integral-dominated PID ahead of the inverse of the plant's hysteresis.

    ``dt`` in s. Raises ValueError if there is no inverse between ``limits`` (V), and in
    the cases of ``design_model`` and ``DesignModel.fastest_stable``.
    """
    model = design_model(plant, dt, limits)
    inverse = model.inverse()

    def pid(pace: float) -> PID:
        scale = pace / model.dynamics.dc_gain()
        return PID(
            0.05 * scale, 0.05 * scale / dt, 1e-3 * scale * dt, dt, 0.1 / dt, dt=dt
        )

    return InversionControl(model.fastest_stable(pid), inverse)


def _sliding_mode(model: ARMA, dt: float, pace: float) -> SlidingMode:
    # Scaled from the printed P-753 set, with a surface of 0.5 / dt in place of
    # 0.9 / dt: at any rate the loop crosses over near CROSSOVER * pace / dt.
    surface, weight = 0.5 / dt, 100.0
    scale = pace / model.dc_gain()
    integral = CROSSOVER * weight / (dt * surface)
    gains = 1e-3 * scale, integral * scale, 1e-3 * dt * scale
    return SlidingMode(
        # 0.1 1/s hardly acts, but a search on a logarithmic scale can begin there.
        SwitchingPID(*gains, dt=dt, anti_windup=0.1),
        surface=surface,
        error_weight=1.0,
        control_weight=weight,
        model=model,
        filter=AlphaBeta(0.3, 1e-3, dt),
        correction=pace,
    )


DESIGNS: dict[str, Callable[[System, float, Limits], System]] = {
    "inversion_sliding_mode": inversion_sliding_mode,
    "disturbance_observer_sliding_mode": disturbance_observer_sliding_mode,
    "inversion_pid": inversion_pid,
}
"""Designs by the name a study uses."""
