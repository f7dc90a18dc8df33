"""Four actuators under the plate of the P-558.TCD stage: an assumption of ours.

The thesis commands Z, Rx and Ry and gives no number, position or travel of the
actuators. This model has four equal actuators in the corners of a square, which lift a
rigid plate through equal stiffnesses. The plate then takes the least-squares pose of
their elongations.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..control.allocation import Allocation
from ..core.axes import Packed, PerAxis
from ..core.system import Series, System, series
from ..dynamics import ARMA, LinearMap, StateSpace
from ..hysteresis import PrandtlIshlinskii
from .p558_control import ARX
from .p558_stage import HYSTERESIS, PLAY

POSITIONS = ((50.0, 50.0), (-50.0, 50.0), (-50.0, -50.0), (50.0, -50.0))
"""(x, y) of each actuator in mm, counterclockwise."""

TRAVEL = (0.0, 50.0)
"""Bounds of each actuator's elongation, um."""

GAINS = (1.0, 1.02, 0.98, 1.01)
"""Gains of the actuators of ``four_actuators``."""


def elongations() -> Float[np.ndarray, "4 3"]:
    """Return the matrix [4, 3] from a pose (um, urad, urad) to elongations in um.

    q = Z + y Rx - x Ry, x and y in m.
    """
    return np.array([(1.0, 1e-3 * y, -1e-3 * x) for x, y in POSITIONS])


def geometry() -> Float[np.ndarray, "3 4"]:
    """Return the matrix [3, 4] from elongations in um to a pose (um, urad, urad)."""
    # The pseudo-inverse: for a square the columns are orthogonal.
    return elongations().T / np.sum(elongations() ** 2, axis=0)[:, None]


def allocation(method: str = "bounded") -> Allocation:
    """Return the Allocation of a pose to the four elongations in um, by ``method``."""
    lower, upper = (jnp.full(len(POSITIONS), bound) for bound in TRAVEL)
    return Allocation(geometry(), lower, upper, method)


def stage(actuator: StateSpace, method: str = "bounded") -> Series:
    """Return the stage with four equal actuators, from a wanted to a reached pose.

    Named parts ``allocation``, ``actuators`` and ``plate``. Raises ValueError unless
    ``actuator`` has one input and one output, both in um.
    """
    if actuator.B.shape[1] != 1 or actuator.C.shape[0] != 1:
        raise ValueError(
            f"actuator has {actuator.B.shape[1]} inputs and {actuator.C.shape[0]} "
            "outputs; it must have one of each"
        )
    A, B, C, D = (
        np.kron(np.eye(len(POSITIONS)), np.asarray(matrix))
        for matrix in (actuator.A, actuator.B, actuator.C, actuator.D)
    )
    return series(
        allocation=allocation(method),
        actuators=StateSpace(A, B, C, D, actuator.dt),
        plate=LinearMap(geometry()),
    )


def four_actuators() -> Series:
    """Return the stage on four actuators, each with the play of ``p558_stage``.

    Each has the dynamics of (8.40), the model of the Z axis, with unit DC gain; their
    gains differ: ``GAINS``. A commanded pose is allocated to them within their travel.
    """
    (a, b), *_ = ARX
    gain = sum(b) / (1.0 - sum(a))
    return axes_stage(
        tuple(
            series(
                hysteresis=PrandtlIshlinskii(
                    (share * (1.0 - HYSTERESIS),), (PLAY,), (share * HYSTERESIS,)
                ),
                dynamics=ARMA(a, (b[0] / gain, b[1] / gain, 0.0)),
            )
            for share in GAINS
        )
    )


def axes_stage(
    actuators: Sequence[System], sharing: Allocation | None = None
) -> Series:
    """Return the stage as the plant of a loop of several axes: tuples of scalars.

    It maps a commanded pose to the reached one. ``sharing``, ``allocation()`` by
    default, gives the commands of the four ``actuators``, scalar systems with any
    dynamics and hysteresis. Named parts as in ``stage``. Raises ValueError unless there
    are four.
    """
    if len(actuators) != len(POSITIONS):
        raise ValueError(f"{len(actuators)} actuators; there must be {len(POSITIONS)}")
    return series(
        allocation=Packed(allocation() if sharing is None else sharing),
        actuators=PerAxis(tuple(actuators)),
        plate=Packed(LinearMap(geometry())),
    )
