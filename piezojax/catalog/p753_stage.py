"""The P-753 with creep, a lightly damped mode and deviations from nominal values.

The printed model (``p753.plant``) has two real poles only. A real stage also creeps,
and its flexure has a mode: at 5.6 kHz +- 20 % unloaded according to its manufacturer,
and lower with a load. Creep and mode are assumptions of ours, not printed.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.system import Affine, Series, series
from ..dynamics import ARMA, ExponentialCreep, FractionalDelay, SecondOrderLag
from ..hysteresis import ColemanHodgdon
from . import p753

CREEP = {"gains": (0.01, 0.01, 0.01), "time_constants": (0.03, 0.3, 3.0)}
"""Creep: shares of a step, and time constants in s. 1 % per decade is typical."""

MODE_FREQUENCY = 4_000.0
"""Frequency of the mode in Hz, for a load between 0 (5.6 kHz) and 200 g."""

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
    """Return the stage at 20 kHz, V to um, with deviations from its nominal values.

    Relative deviations: ``gain`` at rest; ``poles`` and ``zeros``, the rate of each (z
    becomes z^(1 + deviation)); ``hysteresis``, a and c, which set the width of the
    loop; ``creep``. Absolute values: ``delay`` in samples, from 0 to 1;
    ``mode_frequency`` in Hz and ``mode_damping`` of a mode of unit DC gain in series.
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
    """Return (5.33) with unit DC gain, its roots raised to 1 + their deviation."""
    printed = ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS)
    roots = np.array([printed.poles(), printed.zeros()])
    return ARMA(*_coefficients(np.log(roots + 0j), poles, zeros))


# Compiled as one program instead of one for each operation.
@jax.jit
def _coefficients(
    logarithms: Complex[Array, "2 2"], poles: Scalar, zeros: Scalar
) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
    """Return the coefficients of ``ARMA`` from the logarithms of poles and zeros."""
    _, *denominator = _moved(logarithms[0], poles)
    numerator = _moved(logarithms[1], zeros)
    scale = (1.0 + sum(denominator)) / sum(numerator)
    return tuple(-a for a in denominator), tuple(b * scale for b in numerator)


def _moved(
    logarithms: Complex[Array, "2"], faster: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Return 1, c_1, c_2 of the polynomial with its roots raised to 1 + ``faster``."""
    first, second = jnp.exp((1.0 + faster) * logarithms)
    one = jnp.ones_like(faster)
    return one, -jnp.real(first + second), jnp.real(first * second)
