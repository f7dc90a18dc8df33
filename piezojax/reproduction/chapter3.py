"""Tables 3-6 and 3-7: prediction errors of three discretisations of hysteresis."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from ..catalog import p753
from ..core.system import Series, System, series
from ..dynamics import ARMA, scaled_to_dc
from ..hysteresis import ColemanHodgdon
from ..identification import Orders, Record, free_run, instrumental_variables
from ..signals import waveforms as signals
from .cell import Cell, printed, window

TABLES = {"3-6": ("voros", "trapezoid"), "3-7": ("trapezoid", "quadratic")}
"""Discretisation schemes of each table, which are its columns."""

AMPLITUDE = 35.0
"""Amplitude of the inputs, V; those of the thesis have 70 V peak to peak."""

C_BOUNDS = (-0.1, -0.01)
"""Bounds of c, 1/V, around its first fit in the thesis, -0.0378."""

TRAINING = {"SIN1": 1.0, "SIN10": 0.2, "SIN50": 0.1, "SIN100": 0.1, "SIN200": 0.1}
"""Consecutive sines of the identification record, and their duration, s."""


def simulated_stage() -> Series:
    """Return the simulated stage that replaces the hardware of the thesis, V to um.

    The exact hysteresis with a, b and c of chapter 3 is followed by the denominator and
    the y_2 numerator of Table 3-2, scaled to unit DC gain. The exact solution favours
    none of the discretisations.
    """
    model = p753.ARMA_HYSTERESIS["3-2"]
    dynamics = ARMA(model["autoregressive"], model["moving_2"])
    return series(
        hysteresis=ColemanHodgdon(**p753.HYSTERESIS_CHAPTER_3, scheme="exact"),
        dynamics=scaled_to_dc(dynamics, 1.0),
    )


@jax.jit
def _output(system: System, voltage: jax.Array) -> jax.Array:
    return free_run(system, voltage, voltage[0])


def _noise(samples: int, seed: int) -> np.ndarray:
    return p753.NOISE_RMS * np.random.default_rng(seed).standard_normal(samples)


def _voltage(name: str, duration: float) -> jax.Array:
    return signals.signal(name, signals.time_grid(duration, p753.RATE), AMPLITUDE)


@cache
def _model(scheme: str) -> System:
    voltage = jnp.concatenate([_voltage(*part) for part in TRAINING.items()])
    clean = np.asarray(_output(simulated_stage(), voltage))
    output = clean + _noise(voltage.size, seed=0)
    record = Record(np.asarray(voltage), output, p753.DT)
    structure = Orders(scheme=scheme)
    return instrumental_variables(record, structure, c=C_BOUNDS).model


def cells(table: str) -> list[Cell]:
    """Return the 22 cells of ``table`` ("3-6" or "3-7"), simulated.

    One reading of the thesis applies to all cells; nothing is tuned.
    ``simulated_stage`` with the white noise of the sensor, ``p753.NOISE_RMS``, replaces
    the hardware. Every scheme is identified from one record of 70 V sines up to 200 Hz.
    The thesis does not define its online estimation. The poles it gives (Tables 3-2,
    3-4) are free of the bias of least squares, so refined instrumental variables
    replace it. The error is the RMS of the free run minus the measured displacement,
    from rest, over the second of two windows.

    The simulated errors contain the errors of the discretisation and the noise. They do
    not contain the effects that only the hardware has, which cause most of the printed
    errors.
    """
    paper = printed("ch3", table)
    simulated = []
    for seed, name in enumerate(dict.fromkeys(row for row, _ in paper), start=1):
        voltage = _voltage(name, 2.0 * window(name))
        measured = _output(simulated_stage(), voltage) + _noise(voltage.size, seed)
        for scheme in TABLES[table]:
            error = (_output(_model(scheme), voltage) - measured)[voltage.size // 2 :]
            rms = float(jnp.sqrt(jnp.mean(error**2)))
            simulated.append(paper[name, scheme].simulated(rms))
    return simulated
