"""Four actuators under the plate of the P-558.TCD stage: an assumption of ours.

The thesis commands Z, Rx and Ry and does not say how many actuators there are, where
they stand or how far they go. Assumed here: four alike in the corners of a square, each
pushing up through the same stiffness, so that the plate, which is rigid, takes the pose
that fits their elongations best.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..control.allocation import Allocation
from ..core.axes import Packed, PerAxis
from ..core.system import Series, System, series
from ..dynamics import LinearMap, StateSpace

POSITIONS = ((50.0, 50.0), (-50.0, 50.0), (-50.0, -50.0), (50.0, -50.0))
"""(x, y) of each actuator, mm; counterclockwise."""

TRAVEL = (0.0, 50.0)
"""Bounds of each actuator's elongation, um."""


def elongations() -> Float[np.ndarray, "4 3"]:
    """Return what a pose (um, urad, urad) asks of each actuator, um.

    q = Z + y Rx - x Ry, x and y in m.
    """
    return np.array([(1.0, 1e-3 * y, -1e-3 * x) for x, y in POSITIONS])


def geometry() -> Float[np.ndarray, "3 4"]:
    """Return what elongations (um) make of the plate: Z in um, Rx and Ry in urad."""
    # The pseudo-inverse: in a square the columns are orthogonal to each other.
    return elongations().T / np.sum(elongations() ** 2, axis=0)[:, None]


def allocation(method: str = "bounded") -> Allocation:
    """Return the allocation of a pose to the four, um."""
    lower, upper = (jnp.full(len(POSITIONS), bound) for bound in TRAVEL)
    return Allocation(geometry(), lower, upper, method)


def stage(actuator: StateSpace, method: str = "bounded") -> Series:
    """Return the stage from a wanted pose to its pose, four times ``actuator`` inside.

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


def axes_stage(
    actuators: Sequence[System], sharing: Allocation | None = None
) -> Series:
    """Return the stage as the plant of a loop of several axes: tuples of scalars.

    From a commanded pose to the pose that ``actuators``, systems of a scalar each of
    whatever dynamics and hysteresis, make of the share that ``sharing`` gives them,
    ``allocation()`` unless told. Named parts as in ``stage``. Raises ValueError unless
    there are four.
    """
    if len(actuators) != len(POSITIONS):
        raise ValueError(f"{len(actuators)} actuators; there must be {len(POSITIONS)}")
    return series(
        allocation=Packed(allocation() if sharing is None else sharing),
        actuators=PerAxis(tuple(actuators)),
        plate=Packed(LinearMap(geometry())),
    )
