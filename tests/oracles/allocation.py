"""Control allocation by general solvers and by the geometry of the P-558."""

import numpy as np
from scipy import sparse
from scipy.optimize import linprog, lsq_linear

PLATE = np.array([[0.25, 0.25, 0.25, 0.25], [5, 5, -5, -5], [-5, 5, 5, -5]])
"""From elongations (um) of actuators at (+-50, +-50) mm to Z (um), Rx, Ry (urad)."""

ELONGATIONS = np.array(
    [(1, 0.05, -0.05), (1, 0.05, 0.05), (1, -0.05, 0.05), (1, -0.05, -0.05)]
)
TWIST = np.array([1, -1, 1, -1]) / 2


def out_of_reach(geometry, lower, upper, poses):
    """Return the least sum of abs(pose - geometry q) for q in bounds, by pose.

    One linear program for all poses; deficit and excess are its slack variables.
    """
    axes, actuators = geometry.shape
    count = len(poses)
    block = np.hstack([geometry, np.eye(axes), -np.eye(axes)])
    bounds = [*zip(lower, upper, strict=True), *[(0.0, None)] * (2 * axes)]
    found = linprog(
        np.tile([0.0] * actuators + [1.0] * (2 * axes), count),
        A_eq=sparse.kron(sparse.eye_array(count), block, format="csr"),
        b_eq=np.ravel(poses),
        bounds=np.tile(np.array(bounds, dtype=object), (count, 1)),
        method="highs",
    )
    assert found.success
    return found.x.reshape(count, -1)[:, actuators:].sum(axis=1)


def least_squares(geometry, lower, upper, pose, axis_weights=1.0):
    """Return q within bounds with the least weighted sum of squared errors."""
    by_axis = np.sqrt(np.broadcast_to(axis_weights, len(geometry)))
    scaled = by_axis[:, None] * geometry
    bounds = (lower, upper)
    return lsq_linear(scaled, by_axis * pose, bounds, method="bvls", tol=1e-14).x


def least_effort(geometry, lower, upper, pose, weights, axis_weights, cost=1e-4):
    """Return such q with nearly the least weighted sum q^2.

    The sum is added at a small cost, so that q is off by about its square.
    """
    tall = np.vstack([geometry, np.eye(len(lower))])
    cheap = cost**2 * np.asarray(weights)
    wanted = np.concatenate([pose, np.zeros(len(lower))])
    return least_squares(tall, lower, upper, wanted, [*axis_weights, *cheap])


def shifted(poses, lower=0.0, upper=50.0):
    """Return elongations of the P-558, shifted along the twist as little as possible.

    Also return whether the bounds can be kept, by pose.
    """
    least = poses @ ELONGATIONS.T
    ends = np.stack([(lower - least) / TWIST, (upper - least) / TWIST])
    low, high = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    shift = np.clip(0.0, low, np.maximum(low, high))
    return least + shift[:, None] * TWIST, low <= high
