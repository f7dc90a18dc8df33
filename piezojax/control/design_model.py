"""Design models: a plant as a static part and second-order linear dynamics."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.feedback import Feedback, LoopInput
from ..core.system import Affine, Series, System, rest_output
from ..dynamics import (
    ARMA,
    AmplifierSlew,
    StateSpace,
    fast_part,
    linearise,
    reduced,
    scaled_to_dc,
)
from ..hardware import Sensor
from ..hysteresis import HystereticARMA
from ..hysteresis.inverse import Inverse
from ..hysteresis.model import Hysteresis, hystereses
from .inversion import InverseGain

S = TypeVar("S", bound=System)

CROSSOVER = 0.1
"""Highest crossover frequency of a design, rad per sample."""

GAIN_MARGIN = 3.0
"""Factor on the plant's gain at which a designed loop must still be stable."""

SMALLEST_PACE = 1e-4
"""Pace below which ``DesignModel.fastest_stable`` gives up."""


class NoInverseError(ValueError):
    """The hysteresis of a plant has no inverse between the limits of the actuator."""


class DesignModel(NamedTuple):
    """A plant as a static part, from V to um, and linear dynamics, from um to um.

    ``hysteresis`` is that of the plant, or None. ``static`` equals ``hysteresis``, or
    is a gain if the plant has no hysteresis that can be separated from its dynamics.
    ``linear`` is the plant behind ``static``, unreduced; ``dynamics`` is its fast part
    reduced to second order, a_1, a_2 | b_0, b_1, b_2 with b_0 not zero and zeros inside
    the unit circle. ``limits`` are those of the actuator (V); ``rest`` is the output of
    ``static`` (um) in the middle between them; ``dt`` in s.
    """

    hysteresis: Hysteresis | None
    static: System
    linear: System
    dynamics: ARMA
    limits: tuple[float, float]
    rest: Scalar
    dt: float

    def inverse(self) -> Inverse:
        """Return the inverse of the hysteresis between the limits, or of the gain.

        Raises NoInverseError with the reason if the hysteresis has no inverse.
        """
        if self.hysteresis is None:
            assert isinstance(self.static, Affine)
            return InverseGain(self.static)
        try:
            return self.hysteresis.inverse(*self.limits)
        except ValueError as error:
            lower, upper = self.limits
            raise NoInverseError(
                f"no inverse of the hysteresis from {lower:g} to {upper:g} V: {error}"
            ) from None

    def gain(self) -> Scalar:
        """Return the mean slope of ``static`` between the limits, um/V."""
        lower, upper = self.limits
        rise = rest_output(self.static, upper) - rest_output(self.static, lower)
        return rise / (upper - lower)

    def total_gain(self) -> Scalar:
        """Return the mean slope of the plant between the limits at rest, um/V."""
        return self.gain() * self.dynamics.dc_gain()

    def check_rising(self, need: str) -> None:
        """Raise ValueError, which ends with ``need``, unless ``total_gain`` is > 0."""
        gain = float(self.total_gain())
        if gain <= 0.0:
            raise ValueError(
                f"the output falls as the voltage rises, {gain:.6g} um/V between the "
                f"limits; {need}"
            )

    def fastest_stable(
        self, make: Callable[[float], S], static: System | None = None
    ) -> S:
        """Return ``make(pace)`` for the largest pace of 1, 1/2, ... with a stable loop.

        The pace scales the crossover frequency. The loop contains all of ``linear``,
        behind ``static`` if given. It must stay stable with ``GAIN_MARGIN`` times the
        gain, because a resonance or a delay beyond second order limits the crossover.
        Raises ValueError if no pace down to ``SMALLEST_PACE`` gives a stable loop.
        """
        plant = self.linear if static is None else static >> self.linear
        held = self.rest if static is None else as_array(np.mean(self.limits))
        pace = 1.0
        while pace >= SMALLEST_PACE:
            controller = make(pace)
            if all(
                _radius(controller, plant >> Affine(gain), held) <= 1.0 + 1e-9
                for gain in (1.0, GAIN_MARGIN)
            ):
                return controller
            pace /= 2.0
        raise ValueError(
            "the loop around the plant's linear part is unstable at any crossover down "
            f"to {SMALLEST_PACE * CROSSOVER / self.dt:g} rad/s; "
            "no slower design exists: give the controller as catalog, file or type"
        )


def design_model(plant: System, dt: float, limits: tuple[float, float]) -> DesignModel:
    """Return the design model of ``plant`` for a loop with sample time ``dt`` (s).

    ``limits`` are those of the actuator (V). Raises ValueError for a plant of several
    inputs or outputs, with hysteresis that is not in series with the other parts or
    occurs twice, or whose fast part is unstable or has no gain at rest.
    """
    hysteresis, others = _separated(plant)
    middle = as_array(np.mean(limits))
    if hysteresis is not None and not hysteresis.dynamic:
        static: System = hysteresis
        linear: System = Series(others) if others else Affine()
    else:
        gain = _gain(_fast(plant, middle, dt))
        static, linear = Affine(gain), Affine(1.0 / gain) >> plant
    rest = rest_output(static, middle)
    fast = _fast(linear, rest, dt)
    dynamics = scaled_to_dc(_second_order(fast), _gain(fast))
    return DesignModel(hysteresis, static, linear, dynamics, limits, rest, dt)


def _separated(plant: System) -> tuple[Hysteresis | None, tuple[System, ...]]:
    """Return the hysteresis of ``plant``, or None, and the other parts."""
    parts = _in_series(plant)
    hysteretic = [part for part in parts if isinstance(part, Hysteresis)]
    if len(hystereses(plant)) != len(hysteretic) or len(hysteretic) > 1:
        raise ValueError(
            "a design needs one hysteresis in series with linear parts; the plant has "
            f"{', '.join(type(part).__name__ for part in parts)}"
        )
    # A slew limit is left out: it acts on large steps only, ahead of the hysteresis.
    apart = (Hysteresis, AmplifierSlew)
    others = tuple(part for part in parts if not isinstance(part, apart))
    return (hysteretic[0] if hysteretic else None), others


def _in_series(plant: System) -> tuple[System, ...]:
    if isinstance(plant, HystereticARMA):
        # Approximate its two operators by one, with the nearest shared numerator.
        plant = plant.cascade(1.0)
    if not isinstance(plant, Series):
        return (plant,)
    return tuple(inner for part in plant.parts for inner in _in_series(part))


def _fast(system: System, input: Scalar, dt: float) -> StateSpace:
    """Return the fast part of ``system`` linearised at rest under ``input``."""
    whole = _linearised(system, input, dt)
    if whole.D.shape != (1, 1):
        outputs, inputs = whole.D.shape
        raise ValueError(
            f"the plant has {inputs} inputs and {outputs} outputs; a design needs one "
            "of each"
        )
    if not all(np.all(np.isfinite(m)) for m in (whole.A, whole.B, whole.C, whole.D)):
        raise ValueError(
            "a derivative of the plant is not finite; a design needs finite ones"
        )
    # Creep and other modes near z = 1 act far below the crossover, where the integral
    # suppresses them like any drift. At the crossover the plant has the gain of its
    # fast part, so a reduction to few states must not use any for the slow modes.
    fast = fast_part(whole, CROSSOVER)
    radius = np.max(np.abs(fast.poles()), initial=0.0)
    if radius >= 1.0:
        raise ValueError(
            f"the plant has a pole of modulus {radius:.6g}; a design needs a plant "
            "that comes to rest, with all poles below 1"
        )
    return fast


@eqx.filter_jit
def _linearised(system: System, input: Scalar, dt: float) -> StateSpace:
    return linearise(system, input, dt=dt)


def _gain(fast: StateSpace) -> float:
    gain = float(fast.dc_gain()[0, 0])
    if gain == 0.0:
        raise ValueError(
            "the plant's fast part has no gain at rest; a design needs one"
        )
    return gain


def _second_order(fast: StateSpace) -> ARMA:
    """Return ``fast`` reduced to a_1, a_2 | b_0, b_1, b_2, padded with zeros."""
    arma = reduced(fast, 2).as_arma()
    a, b = np.zeros(2), np.zeros(3)
    a[: len(arma.autoregressive)] = arma.autoregressive
    b[: len(arma.moving)] = arma.moving
    if abs(b[0]) <= 1e-9 * np.abs(b).sum() or np.any(np.abs(np.roots(b)) >= 1.0):
        # A delay, or zeros outside the unit circle, cannot be inverted: the numerator
        # is replaced by its sum, as in chapter 8.
        b = np.array([b.sum(), 0.0, 0.0])
    return ARMA(tuple(a), tuple(b))


def _radius(controller: System, plant: System, held: ScalarLike) -> float:
    """Return the largest modulus of the poles of the closed loop."""
    A = np.asarray(_closed(controller, plant, as_array(held)))
    return float(np.abs(np.linalg.eigvals(A)).max()) if np.isfinite(A).all() else np.inf


@eqx.filter_jit
def _closed(controller: System, plant: System, held: Scalar) -> Float[Array, "n n"]:
    loop = Feedback(controller, plant, Affine(), Sensor(0.0))
    reference = rest_output(plant, held)
    start = loop.init(reference, held)
    return linearise(loop, LoopInput(reference, as_array(0.0)), start, 1.0).A
