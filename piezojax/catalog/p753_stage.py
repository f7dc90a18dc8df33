"""The P-753 as a lab meets it: with creep, a lightly damped mode, and off its values.

The printed model (``p753.plant``) stops at two real poles. A stage also creeps, and its
flexure has a mode: 5.6 kHz +- 20 % unloaded says its maker, lower with a load on it.
Neither is printed for this stage: both are assumptions of ours.
"""

import jax.numpy as jnp
import numpy as np

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.system import Affine, Series, series
from ..dynamics import ARMA, ExponentialCreep, FractionalDelay, SecondOrderLag
from ..hysteresis import ColemanHodgdon
from . import p753

CREEP = {"gains": (0.01, 0.01, 0.01), "time_constants": (0.03, 0.3, 3.0)}
"""Creep: shares of a step, and times in s. 1 % a decade is of the usual size."""

MODE_FREQUENCY = 4_000.0
"""Of the lightly damped mode, Hz: with a load, between none (5.6 kHz) and 200 g."""

MODE_DAMPING = 0.02
"""Damping ratio of the mode."""


def stage(
    gain: ScalarLike = 0.0,
    poles: ScalarLike = 0.0,
    zeros: ScalarLike = 0.0,
    hysteresis: ScalarLike = 0.0,
    creep: ScalarLike = 0.0,
    delay: ScalarLike = 0.0,
    mode_frequency: ScalarLike = MODE_FREQUENCY,
    mode_damping: ScalarLike = MODE_DAMPING,
) -> Series:
    """Return the stage at 20 kHz, V to um, off its nominal values as given.

    Relative deviations, 0 for none: ``gain`` at rest; ``poles``, ``zeros``, how much
    faster they are (z becomes z^(1 + deviation)); ``hysteresis``, the size of a and c,
    the width of the loop; ``creep``. ``delay`` in samples, from 0 to 1;
    ``mode_frequency`` in Hz and ``mode_damping`` of a mode of unit gain at rest that
    the stage has in series.
    """
    material = p753.HYSTERESIS_CHAPTER_5
    return series(
        hysteresis=ColemanHodgdon(
            material["a"] * (1.0 + hysteresis),
            material["b"],
            material["c"] * (1.0 + hysteresis),
        ),
        creep=ExponentialCreep(
            tuple(share * (1.0 + creep) for share in CREEP["gains"]),
            CREEP["time_constants"],
            p753.DT,
        ),
        gain=Affine(1.0 + gain),
        dynamics=_dynamics(as_array(poles), as_array(zeros)),
        delay=FractionalDelay(as_array(delay) * p753.DT, p753.DT, 1),
        mode=SecondOrderLag(2.0 * jnp.pi * mode_frequency, mode_damping, p753.DT),
    )


def _dynamics(poles: Scalar, zeros: Scalar) -> ARMA:
    """Return (5.33) with unit DC gain, its roots moved along their rays of time."""
    printed = ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS)
    _, *denominator = _moved(printed.poles(), poles)
    numerator = _moved(printed.zeros(), zeros)
    scale = (1.0 + sum(denominator)) / sum(numerator)
    return ARMA(tuple(-a for a in denominator), tuple(b * scale for b in numerator))


def _moved(roots: np.ndarray, faster: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return 1, c_1, c_2 of the polynomial with both ``roots`` to 1 + ``faster``."""
    first, second = (jnp.exp((1.0 + faster) * np.log(root + 0j)) for root in roots)
    one = jnp.ones_like(faster)
    return one, -jnp.real(first + second), jnp.real(first * second)
