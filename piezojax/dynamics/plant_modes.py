"""Lightly damped modes of a plant, from its linearisation."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from scipy import linalg

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.feedback import holding_input
from ..core.system import System
from .linearise import linearise
from .state_space import StateSpace

LIGHT = 0.2
"""Damping ratio below which a pair of poles is a mode; filters have larger ones."""

HIGHEST = 0.45
"""Highest frequency of a mode, in cycles per sample."""


class PlantMode(NamedTuple):
    """Mode of a plant: undamped natural ``frequency`` (Hz) and ``damping`` ratio.

    Its term in the partial fractions of the plant peaks near ``angle`` (rad/sample).
    ``gain`` is the modulus of this term at ``angle``, in the unit of the plant.
    ``share`` is ``gain`` over the modulus of the whole plant at ``angle``. A mode that
    is hardly excited or measured has a small gain.
    """

    frequency: float
    damping: float
    angle: float
    gain: float
    share: float


def plant_modes(plant: System, reference: ScalarLike, dt: float) -> list[PlantMode]:
    """Return the lightly damped modes of a plant of one axis, sorted by frequency.

    The plant is linearised at rest at ``reference`` (um); ``dt`` is the sample time in
    s. The list is empty for a plant without finite derivatives.
    """
    model = _linearised(plant, as_array(reference), dt)
    A, B, C, D = (np.asarray(m) for m in (model.A, model.B, model.C, model.D))
    if not all(np.isfinite(m).all() for m in (A, B, C, D)):
        return []
    decomposed: Any = linalg.eig(A, left=True, right=True)
    poles, left, right = decomposed
    found = []
    for i in np.flatnonzero((poles.imag > 1e-9) & (np.abs(poles) < 1.0)):
        rate, angle = np.log(poles[i]), float(np.angle(poles[i]))
        damping = float(-rate.real / np.abs(rate))
        if damping >= LIGHT or angle > 2.0 * math.pi * HIGHEST:
            continue
        z, (v, w) = np.exp(1j * angle), (right[:, i], left[:, i].conj())
        residue = (C[0] @ v) * (w @ B[:, 0]) / (w @ v)
        own = float(np.abs(residue / (z - poles[i])))
        whole = C[0] @ np.linalg.solve(z * np.eye(len(A)) - A, B[:, 0]) + D[0, 0]
        found.append(
            PlantMode(
                frequency=float(np.abs(rate)) / (2.0 * math.pi * dt),
                damping=damping,
                angle=angle,
                gain=own,
                share=own / max(float(np.abs(whole)), np.finfo(float).tiny),
            )
        )
    return sorted(found)


@eqx.filter_jit
def _linearised(plant: System, reference: Scalar, dt: float) -> StateSpace:
    return linearise(plant, holding_input(plant, reference), dt=dt)
