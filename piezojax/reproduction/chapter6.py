"""Tables 6-7 and 6-8: predictions by models identified with and without a prior."""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..catalog import p558
from ..core.rollout import simulate
from ..dynamics import StateSpace
from ..hysteresis import ColemanHodgdon
from ..identification.estimators.subspace import (
    PRIOR,
    Estimate,
    identify_channel,
    least_squares,
    simulation_errors,
)
from ..identification.records.record import Record
from .cell import Cell, printed

ORDERS = (7, 4, 4)
"""States of the three channel models, section 6.5.4.2."""


@dataclass(frozen=True)
class Method:
    """An estimate of the Hankel-Toeplitz parameters and p for each channel."""

    estimate: Estimate
    p: tuple[int, int, int]


METHODS = {
    "6-7": Method(PRIOR, (38, 42, 39)),
    "6-8": Method(partial(least_squares, tolerance=1e-4), (21, 4, 7)),
}
"""6-7: p beside the chosen orders in Tables 6-4 to 6-6; 6-8: p of section 6.5.4.3."""

TABLES = tuple(METHODS)
"""The tables of this chapter."""

FREQUENCIES = (1, 5, 10)
"""Hz, of the sines that are predicted."""

CHIRP_S, SINE_S = 10.0, 4.0
"""Length of the chirps and of the sines, s; the chirps' is not printed."""

CHIRPS = ((20.0, 20.0), (200.0, 0.0), (200.0, 0.0))
SINES = ((10.0, 10.0), (200.0, 0.0), (200.0, 0.0))
"""Amplitude and offset of each channel's command, um and urad."""

LOOP = 0.01
"""Half the width of the stage's hysteresis as a share of the chirp's amplitude."""


def cells(table: str) -> list[Cell]:
    """Return the 27 cells of ``table`` ("6-7" or "6-8"), simulated.

    The stage is not published, so the printed model (6.23)-(6.25) stands in for it,
    each command passing through a hysteresis of 1 % and each output with the sensor
    noise of the stage's other tables. Every channel is identified from a linear chirp
    from 1 to 100 Hz and predicts sines of 1, 5 and 10 Hz in a free run; a cell is the
    rms error over the second half of 4 s. Nothing is tuned per cell.

    6-7 is MAP with its prior. 6-8, the method it is compared with, is least squares
    without one. Taken literally that fails on a chirp (errors of 1e2 to 1e8 urad), so
    the printed method must have been regularised in some way: here directions weaker
    than 1e-4 of the strongest are left out. Poles outside the unit circle are
    reflected. What can be compared is the driven axes and the order of the two tables:
    a linear stand-in has none of the coupling that a linear model fails to predict.
    """
    method = METHODS[table]
    prints = printed("ch6", table)
    errors = {}
    for channel, stage in enumerate(p558.channels("6")):
        train = _record(stage, channel, _chirp(channel))
        fit = identify_channel(
            train, method.p[channel], ORDERS[channel], method.estimate
        )
        for frequency in FREQUENCIES:
            wave = _record(stage, channel, _sine(channel, frequency))
            errors[frequency, channel] = simulation_errors(
                fit.model, wave, start=wave.samples // 2
            )
    return [
        prints[f"{frequency}Hz_ch{channel + 1}", column].simulated(float(error))
        for frequency in FREQUENCIES
        for channel in range(3)
        for column, error in zip(p558.OUTPUTS, errors[frequency, channel], strict=True)
    ]


def _time(length: float) -> np.ndarray:
    return np.arange(round(length / p558.DT)) * p558.DT


def _chirp(channel: int) -> np.ndarray:
    time = _time(CHIRP_S)
    amplitude, offset = CHIRPS[channel]
    phase = 2.0 * np.pi * (time + 0.5 * (100.0 - 1.0) * time**2 / CHIRP_S)
    return offset + amplitude * np.sin(phase)


def _sine(channel: int, frequency: int) -> np.ndarray:
    amplitude, offset = SINES[channel]
    return offset + amplitude * np.sin(2.0 * np.pi * frequency * _time(SINE_S))


def _record(stage: StateSpace, channel: int, command: np.ndarray) -> Record:
    """What the stage's sensors say while one channel follows ``command``."""
    amplitude = CHIRPS[channel][0]
    # Unit slope; the branch forgets its past within a tenth of the amplitude.
    slope, forgetting = 1.0, 10.0 / amplitude
    hysteresis = ColemanHodgdon(
        a=slope * forgetting,
        b=slope - LOOP * amplitude * forgetting,
        c=-forgetting,
        rest_input=CHIRPS[channel][1],
        rest_output=CHIRPS[channel][1],
        # At 100 Hz a sample is a large step: only the closed form takes it.
        scheme="exact",
    )
    outputs = np.asarray(_outputs(hysteresis, stage, jnp.asarray(command)))
    noise = np.random.default_rng([channel, command.size]).standard_normal
    outputs = outputs + noise(outputs.shape) * p558.NOISE_RMS
    return Record(
        command,
        outputs,
        p558.DT,
        p558.UNITS[channel],
        p558.UNITS,
        source=f"simulated channel {channel + 1}",
    )


@eqx.filter_jit
def _outputs(hysteresis, stage, command):
    moved = simulate(hysteresis, command, hysteresis.init(command[0]))[1]
    return simulate(stage, moved[:, None], stage.init(moved[0]))[1]
