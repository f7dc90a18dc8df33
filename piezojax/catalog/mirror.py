"""Fast-steering mirror: 3 piezo drives, 3 displacements, identified at 6.4 kHz.

The records are M. Floren's (KU Leuven, ``fsm-benchmark-data``, CC BY 4.0; Floren et
al., ISMA-USD 2024, pp. 2042-2052): open loop, orthogonal random-phase multisines on all
lines from 0.78 to 3000 Hz. The models fit the records at 100 mV; their simulation
errors on a held-out realisation are

- order 12: 0.31 um rms,
- order 24: 0.11 um rms,

averaged over the outputs, which move by 1.23, 1.35 and 1.51 um rms. A fit to the whole
band favours the resonances, 640 to 2550 Hz: below 10 Hz the error of its transfer
matrix is 36 % with 12 states and 12 % with 24 (largest singular values). At 200 and
300 mV the resonances are lower, and no linear model fits as well. The records contain
no creep and no closed loop, so stability of a loop on the real mirror is not shown.

Drives in V, displacements in um.
"""

import json
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from ..control.anticipation import Anticipation
from ..control.multi_axis import MultiAxisSlidingMode
from ..control.state_sliding_mode import StateSlidingMode
from ..control.switching import SwitchingPID
from ..core.axes import PerAxis, as_matrices
from ..core.feedback import Feedback
from ..core.system import System
from ..dynamics import MatrixARMA, SecondOrderLag, StateSpace, observability_form
from ..hardware import Saturation, Sensor

DT = 1.0 / 6400.0
"""Sample time of the records, s."""

ORDERS = (12, 24)
"""States of the identified models."""

NOISE_RMS = 0.0127
"""Rms difference of two periods of the records at 100 mV, um."""

SURFACE = (
    (0.998, 0.915, 0.5),
    (1.376, 0.927, 0.646),
    (1.624, 0.759, 1.072),
    (0.223, 0.422, 0.364),
    (1.334, 0.707, 0.908),
)
"""Ours: weights of e(k), ..., e(k+4) by axis, scaled in ``multi_axis``."""

REACHING = (0.534, 0.569, 0.668)
"""Ours: diagonal of PHI."""

PROPORTIONAL, INTEGRAL = 0.13, 148.0
"""Ours: gains of all axes; the integral in 1/s."""

FREQUENCY, DAMPING = 2.0 * np.pi * 150.0, 0.9
"""Ours: natural frequency in rad/s and damping ratio of the reference model."""


STATE_GAINS = {"effort_weight": 10.0, "process": 0.1, "drift": 0.1}
"""Ours: in um/V, V/um and V/um."""


@cache
def _models() -> dict[str, Any]:
    source = files("piezojax.catalog").joinpath("data/mirror.json")
    return json.loads(source.read_text(encoding="utf-8"))["models"]


def model(order: int = 12) -> StateSpace:
    """Return the identified model; D is the response within the sample of the input.

    Raises ValueError for an order that is not among ``ORDERS``.
    """
    if order not in ORDERS:
        raise ValueError(f"order is {order}; it must be one of {list(ORDERS)}")
    matrices = _models()[str(order)]
    A, B, C, D = (matrices[name] for name in "ABCD")
    return StateSpace(A, B, C, D, DT)


def stage(*, order: int = 12) -> MatrixARMA:
    """Return the mirror as the plant of a loop, delayed by a sample for computation."""
    return observability_form(model(order).delayed())


def detailed_stage() -> MatrixARMA:
    """Return the stage with the model of 24 states."""
    return stage(order=24)


def multi_axis() -> MultiAxisSlidingMode:
    """Return the control of chapter 7 of Y. Cao's thesis, on the model of 12 states.

    The model includes a sample of delay. ``SURFACE``, ``REACHING``, ``PROPORTIONAL``
    and ``INTEGRAL`` are ours: a random search maximised the simultaneous margin of all
    axes around ``stage()``. The surface is scaled by the inverse of S B, so the sliding
    variable is in V.

    The gains hold for that model alone. On the model of 24 states the loop is unstable
    (largest modulus of a pole 1.25), because the prediction of chapter 7 needs a model
    of every resonance; ``state_sliding_mode`` is stable on both. The real mirror will
    probably need other gains or a better model.
    """
    plant = stage(order=12)
    scale = _surface_scale(plant)
    none = (0.0, 0.0, 0.0)
    lags = FREQUENCY, DAMPING, DT
    return MultiAxisSlidingMode(
        SwitchingPID((PROPORTIONAL,) * 3, (INTEGRAL,) * 3, none, dt=DT),
        reaching=REACHING,
        decoupling=none,
        surface=as_matrices(scale @ np.diag(weights) for weights in SURFACE),
        model=plant,
        reference_model=PerAxis(tuple(SecondOrderLag(*lags) for _ in range(3))),
    )


def state_sliding_mode() -> StateSlidingMode:
    """Return state-tracking control on the model of 24 states; gains ours.

    ``STATE_GAINS`` come from a grid of three values each. With them the loop is stable
    on the model of 24 states and on that of 12; the largest moduli of its poles are
    0.990 and 0.996.
    """
    none = (0.0, 0.0, 0.0)
    lags = FREQUENCY, DAMPING, DT
    return StateSlidingMode(
        SwitchingPID(none, none, none, dt=DT),
        model(24).delayed(),
        PerAxis(tuple(SecondOrderLag(*lags) for _ in range(3))),
        reaching=(0.9,) * 3,
        **STATE_GAINS,
    )


def anticipating_state_sliding_mode() -> Anticipation:
    """Return ``state_sliding_mode`` in an Anticipation of lead 0, for tuning."""
    return Anticipation(state_sliding_mode(), (0.0, 0.0, 0.0))


def anticipating_multi_axis() -> Anticipation:
    """Return ``multi_axis`` in an Anticipation of lead 0, for tuning."""
    return Anticipation(multi_axis(), (0.0, 0.0, 0.0))


def _surface_scale(plant: MatrixARMA) -> np.ndarray:
    driven = sum(
        np.diag(weights) @ np.array(response)
        for weights, response in zip(SURFACE, plant.responses(), strict=True)
    )
    return np.linalg.inv(driven)


def loop(
    controller: System, plant: System | None = None, noise_rms: float = NOISE_RMS
) -> Feedback:
    """Return the loop of ``controller`` and ``plant``, by default ``stage()``.

    Drives are limited to +-10 V, about thirty times those of the records.
    ``noise_rms`` in um.
    """
    limits = PerAxis(tuple(Saturation(-10.0, 10.0) for _ in range(3)))
    sensor = PerAxis(tuple(Sensor(noise_rms) for _ in range(3)))
    return Feedback(controller, plant or stage(), limits, sensor)
