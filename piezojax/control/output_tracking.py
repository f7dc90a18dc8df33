"""Equations of output-tracking sliding mode control of any order (chapters 4, 5)."""

from collections.abc import Callable, Iterable
from itertools import pairwise
from math import comb

from ..core.arrays import Scalar, as_array, check_not_zero
from ..dynamics.arma import ARMA

Row = tuple[Scalar, ...]

INVERSIONS: dict[str, Callable[[Scalar, Scalar, Scalar], Scalar]] = {
    "printed": lambda b0, error, control: error / (b0 * (error + control)),
    "tikhonov": lambda b0, error, control: b0 * error / (b0**2 * error + control),
}
"""Inverses of b_0 with the weights Q and R, by name, both 1 / b_0 for R = 0.

"printed" is (4.21): Q weighs the difference of the command from that of the exact
inverse. "tikhonov" weighs the resulting difference of the model's output in um, which
needs the far smaller R of Tables 4-3 and 4-4."""


def check_inversion(form: str, model: ARMA) -> None:
    """Raise ValueError for an unknown form or b_0 = 0."""
    if form not in INVERSIONS:
        raise ValueError(f"inversion {form!r}; it must be one of {list(INVERSIONS)}")
    check_not_zero("b_0 of the model", model.moving[0])


def inversion_gain(form: str, model: ARMA, error: Scalar, control: Scalar) -> Scalar:
    """Return the inverse of b_0 of ``model`` with the weights Q and R."""
    return INVERSIONS[form](model.moving[0], error, control)


def check_has_poles(model: ARMA) -> None:
    """Raise ValueError for a model without a_1."""
    if not model.autoregressive:
        raise ValueError("the model has no coefficient a_1; it must have one")


def derivatives(position: Scalar, velocities: Row, dt: float) -> Row:
    """Return e, de/dt, d2e/dt2, ...: the error state (5.3), (5.5).

    The state holds ``position`` e and backward differences of ``velocities``, those at
    k, k-1, ...; it has one component more than there are velocities.
    """
    found = [position]
    while velocities:
        found.append(velocities[0])
        velocities = tuple((new - old) / dt for new, old in pairwise(velocities))
    return tuple(found)


def sliding(surface: Scalar, state: Row) -> Scalar:
    """Return s = ``surface``^(2-n) (``surface`` + d/dt)^(n-1) e, um/s (5.15).

    n is the size of the error ``state``. The factor before the bracket gives s the same
    unit for any n; for n = 2 it is 1.
    """
    position, *rates = state
    found, share = surface * position, as_array(1.0)
    for i, rate in enumerate(rates, start=1):
        found = found + comb(len(rates), i) * share * rate
        share = share / surface
    return found


def feedforward(
    model: ARMA, next_reference: Scalar, references: Iterable[Scalar]
) -> Scalar:
    """Return v1 (4.6), which moves the model from one reference state to the next.

    ``references`` are r(k), r(k-1), ..., one for each a_i.
    """
    moved = dot(model.autoregressive, references)
    return (next_reference - moved) / model.moving[0]


def drive(model: ARMA, surface: Scalar, dt: float) -> Scalar:
    """Return S B_d of (4.12), the change of s by the control v in one sample."""
    order = len(model.autoregressive)
    unit = [model.moving[0]]  # the error state moved by v = 1, from rest
    for _ in range(order - 1):
        unit.append(unit[-1] / dt)
    return sliding(surface, tuple(unit))


def equivalent_control(
    model: ARMA,
    surface: Scalar,
    position: Scalar,
    velocities: Row,
    dt: float,
) -> Scalar:
    """Return v_eq (4.10), which brings s to zero in one sample.

    The error state of ``derivatives`` gives the past errors of the model:
    e(k-j) = e - dt (de(k)/dt + ... + de(k-j+1)/dt).
    """
    a = model.autoregressive
    past = as_array(0.0)
    rise = (sum(a[1:], a[0]) - 1.0) * position
    for weight, velocity in zip(a[1:], velocities, strict=True):
        past = past + dt * velocity
        rise = rise - weight * past
    moved = (rise / dt, *velocities)[: len(velocities)]
    following = derivatives(position + rise, moved, dt)
    # A quotient of gains is computed once in a scan, one of signals in every step.
    return -(1.0 / drive(model, surface, dt)) * sliding(surface, following)


def inverted(model: ARMA, gain: Scalar, v: Scalar, outputs: Iterable[Scalar]) -> Scalar:
    """Return f = gain [b_0 v - b_1 f(k-1) - ...], the inverse of the numerator."""
    b0, *later = model.moving
    return gain * (b0 * v - dot(later, outputs))


def dot(weights: Iterable[Scalar], values: Iterable[Scalar]) -> Scalar:
    """Return the sum of products up to the end of the shorter sequence."""
    products = [w * value for w, value in zip(weights, values, strict=False)]
    return sum(products[1:], products[0]) if products else as_array(0.0)
