"""The P-753 with Coleman-Hodgdon or Preisach hysteresis, and control by its inverse.

The thesis names the inverse Preisach model first among its future work. The stage with
Preisach hysteresis, the record for the fits of both inverses, and the fits are ours.
Gains and dynamics are the printed ones of ``p753``.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize_scalar

from ..control import InversionControl
from ..core.rollout import simulate
from ..core.system import Series, System, series
from ..dynamics import ARMA, scaled_to_dc
from ..hysteresis import (
    ColemanHodgdon,
    InverseColemanHodgdon,
    InversePreisach,
    Preisach,
)
from ..identification import Record, fit_preisach
from . import p753

CELLS = 20
"""Cells per side of a fitted Preisach model: 7 V each."""

TRUE_CELLS = 28
"""Cells per side of the stage: not a multiple of ``CELLS``, so the two grids differ."""

DENSITY = {"reversible": 0.09, "density": 0.0028, "width": 25.0, "tilt": 0.004}
"""Density of the stage (ours) in um/V, um/V^2, V and 1/V; see ``preisach``."""

RECORD = {"duration": 4.0, "frequency": 5.0, "centre": 50.0, "amplitude": 70.0}
"""Duration in s, frequency in Hz, centre and amplitude in V of the fitted record."""

SEED = 0
"""Seed of the sensor noise in the fitted record."""


def preisach(cells: int = TRUE_CELLS) -> Preisach:
    """Return a Preisach hysteresis (ours) of the size of the P-753's, V to um.

    No density of this stage is published. This one decays with the width of a relay,
    like measured densities of piezo ceramics, and grows along the diagonal:
    density * exp(-(alpha - beta)/width) (1 + tilt ((alpha + beta)/2 - centre)). A part
    without hysteresis adds ``reversible`` um/V. At rest under 0 V the output is 0 um.
    """
    low, high = p753.VOLTAGE_LIMITS
    size = (high - low) / cells
    middle = low + size * (np.arange(cells) + 0.5)
    width = np.maximum(middle[:, None] - middle, 0.0)
    mean = 0.5 * (middle[:, None] + middle)
    weights = np.exp(-width / DENSITY["width"])
    weights *= 1.0 + DENSITY["tilt"] * (mean - 0.5 * (low + high))
    weights = np.tril(DENSITY["density"] * size**2 * weights)
    # Half of a cell on the diagonal lies in the triangle.
    diagonal = 0.5 * np.diag(weights) + DENSITY["reversible"] * size
    weights[np.diag_indices(cells)] = diagonal
    bare = Preisach(weights, low, high)
    return Preisach(weights, low, high, -bare.step(bare.init(0.0), 0.0)[1])


def preisach_plant() -> Series:
    """Return ``p753.plant`` with ``preisach`` as its hysteresis, V to um."""
    return series(hysteresis=preisach(), dynamics=_dynamics())


PLANTS: dict[str, Callable[[], Series]] = {
    "Coleman-Hodgdon": p753.plant,
    "Preisach": preisach_plant,
}
"""The stage by the name of its hysteresis model."""


def _dynamics() -> ARMA:
    return scaled_to_dc(ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS), 1.0)


@eqx.filter_jit
def response(
    system: System, inputs: Float[Array | np.ndarray, " samples"]
) -> Float[Array, " samples"]:
    """Return the output of ``system``, um, along ``inputs``, V, from rest."""
    return simulate(system, jnp.asarray(inputs), system.init(inputs[0]))[1]


def record_of(plant: System, input: np.ndarray | None = None) -> Record:
    """Return a record of ``plant`` at 20 kHz with the printed sensor noise.

    ``input`` (V) is ``excitation()`` if left out: a decaying sine over the whole range
    of the drive, 20 periods in 4 s, from rest at 0 V.
    """
    input = excitation() if input is None else input
    noise = np.random.default_rng(SEED).normal(size=input.size)
    output = np.asarray(response(plant, input)) + p753.NOISE_RMS * noise
    return Record(input, output, p753.DT)


def excitation() -> np.ndarray:
    """Return the input of the fitted record, V."""
    time = np.arange(round(RECORD["duration"] * p753.RATE)) * p753.DT
    left = 1.0 - time / RECORD["duration"]
    wave = np.sin(2.0 * np.pi * RECORD["frequency"] * time)
    swing = RECORD["centre"] + RECORD["amplitude"] * left * wave
    # Rise from 0 V to the centre within the first tenth of a second.
    return swing * np.minimum(time / 0.1, 1.0)


def fitted_preisach(record: Record, cells: int = CELLS) -> Preisach:
    """Return the Preisach model that fits ``record`` behind the printed dynamics."""
    return fit_preisach(
        record,
        cells,
        train=slice(None, None, 4),
        limits=p753.VOLTAGE_LIMITS,
        dynamics=_dynamics(),
    )


def fitted_coleman_hodgdon(record: Record) -> ColemanHodgdon:
    """Return the Coleman-Hodgdon model that fits ``record`` behind the same dynamics.

    For a given c the output is linear in a and b (3.32), which are solved for. A line
    search around the printed value finds c.
    """
    printed = p753.HYSTERESIS_CHAPTER_5
    output, dynamics = record.output, _dynamics()

    def fitted(c: float) -> tuple[np.ndarray, float]:
        parts = [
            response(ColemanHodgdon(a, b, c) >> dynamics, record.input)
            for a, b in ((1.0, 0.0), (0.0, 1.0))
        ]
        matrix = np.column_stack([*parts, np.ones_like(output)])
        values = np.linalg.lstsq(matrix, output, rcond=None)[0]
        return values, float(np.sum((matrix @ values - output) ** 2))

    best: Any = minimize_scalar(
        lambda log: fitted(-float(np.exp(log)))[1],
        bounds=np.log(-printed["c"] * np.array([0.1, 10.0])),
        method="bounded",
        options={"xatol": 1e-6},
    )
    c = -float(np.exp(best.x))
    a, b, rest = fitted(c)[0]
    return ColemanHodgdon(a, b, c, rest_output=rest)


def preisach_inverse(record: Record) -> InversePreisach:
    """Return the inverse of the Preisach model that fits ``record``, um to V."""
    return InversePreisach(fitted_preisach(record))


def coleman_hodgdon_inverse(record: Record) -> InverseColemanHodgdon:
    """Return the inverse of the Coleman-Hodgdon model that fits ``record``, um to V."""
    return InverseColemanHodgdon(fitted_coleman_hodgdon(record))


def preisach_inversion(
    record: Record | None = None, table: str = "5-2"
) -> InversionControl:
    """Return ``p753.inversion`` with an inverse Preisach model, um to V.

    The model is fitted to ``record``, or, without one, is that of the stage on the
    coarser grid of ``CELLS``.
    """
    if record is None:
        inverse = InversePreisach(preisach(CELLS))
    else:
        inverse = preisach_inverse(record)
    return InversionControl(p753.inversion(table).feedback, inverse)
