"""Tables 3-6 and 3-7: how well three discretisations of hysteresis predict."""

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
"""Table: the schemes it compares, which are its columns."""

AMPLITUDE = 35.0
"""V: the inputs of the thesis swing by 70 V."""

SEARCHED = (-0.1, -0.01)
"""Bounds of c, 1/V, about the thesis' first fit of it, -0.0378."""

TRAINING = {"SIN1": 1.0, "SIN10": 0.2, "SIN50": 0.1, "SIN100": 0.1, "SIN200": 0.1}
"""Sines of the identification record, one after the other, and their length in s."""


def truth() -> Series:
    """Return the stage that stands in for the thesis' hardware, V to um.

    The exact hysteresis with chapter 3's a, b and c, then the denominator and the y_2
    numerator of Table 3-2, scaled to unit DC gain: no discretisation is favoured.
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
    output = np.asarray(_output(truth(), voltage)) + _noise(voltage.size, seed=0)
    record = Record(np.asarray(voltage), output, p753.DT)
    structure = Orders(scheme=scheme)
    return instrumental_variables(record, structure, c=SEARCHED).model


def cells(table: str) -> list[Cell]:
    """Return the 22 cells of ``table`` ("3-6" or "3-7"), simulated.

    One reading for all of them, nothing tuned. The hardware is replaced by ``truth``
    with the sensor's white noise, ``p753.NOISE_RMS``. Every scheme is identified from
    one record of 70 V sines up to 200 Hz. The thesis' online estimation is not defined;
    its poles (Tables 3-2, 3-4) are free of the bias of least squares, so refined
    instrumental variables stand for it. The error is the RMS of free run less measured
    displacement over the second half of two windows, from rest. What the hardware does
    and no model here does (most of the printed errors) cannot show up: the simulated
    ones are those of the discretisation and of the noise.
    """
    paper = printed("ch3", table)
    found = []
    for seed, name in enumerate(dict.fromkeys(row for row, _ in paper), start=1):
        voltage = _voltage(name, 2.0 * window(name))
        measured = _output(truth(), voltage) + _noise(voltage.size, seed)
        for scheme in TABLES[table]:
            error = (_output(_model(scheme), voltage) - measured)[voltage.size // 2 :]
            rms = float(jnp.sqrt(jnp.mean(error**2)))
            found.append(paper[name, scheme].simulated(rms))
    return found
