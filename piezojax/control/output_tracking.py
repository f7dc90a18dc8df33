"""Equations of output-tracking sliding mode control (chapters 4 and 5)."""

from collections.abc import Callable

from ..core.arrays import Scalar, check_not_zero
from ..dynamics.arma import ARMA
from .observer import Motion

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


def check_second_order(model: ARMA) -> None:
    """Raise ValueError unless ``model`` has a_1, a_2 and b_0, b_1, b_2."""
    orders = len(model.autoregressive), len(model.moving)
    if orders != (2, 3):
        raise ValueError(
            f"the model has {orders[0]} a and {orders[1]} b coefficients; "
            "it must have 2 and 3"
        )


def tracking_error(
    motion: Motion, reference: Scalar, older_reference: Scalar, dt: float
) -> Motion:
    """Return e1 = y - r in um and e2 = dy/dt - dr/dt in um/s, dr/dt by difference."""
    return Motion(
        motion.position - reference,
        motion.velocity - (reference - older_reference) / dt,
    )


def feedforward(
    model: ARMA, next_reference: Scalar, reference: Scalar, older_reference: Scalar
) -> Scalar:
    """Return v1 (4.6), which moves the model from one reference state to the next."""
    a1, a2 = model.autoregressive
    return (next_reference - a1 * reference - a2 * older_reference) / model.moving[0]


def equivalent_control(
    model: ARMA, surface: Scalar, error: Motion, dt: float
) -> Scalar:
    """Return v_eq (4.10), which brings s = ``surface`` e1 + e2 to zero in one sample.

    The model's state is x = [y, (y - y')/T], driven through B = [b0, b0/T].
    """
    e1, e2 = error
    a1, a2 = model.autoregressive
    b0 = model.moving[0]
    next_e1 = (a1 + a2) * e1 - a2 * dt * e2
    next_e2 = ((a1 + a2 - 1.0) * e1 / dt) - a2 * e2
    return -(1.0 / (surface * b0 + b0 / dt)) * (surface * next_e1 + next_e2)


def inverted(
    model: ARMA, gain: Scalar, v: Scalar, outputs: tuple[Scalar, Scalar]
) -> Scalar:
    """Return f = gain [b0 v - b1 f' - b2 f''], the inverse of the model's numerator."""
    b0, b1, b2 = model.moving
    older, oldest = outputs
    return gain * (b0 * v - b1 * older - b2 * oldest)
