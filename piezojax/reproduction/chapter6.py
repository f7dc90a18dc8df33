"""Tables 6-7 and 6-8: prediction errors of models identified with and without prior."""

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
    Estimator,
    identify_channel,
    least_squares,
    simulation_errors,
)
from ..identification.records.record import Record
from .cell import Cell, printed

ORDERS = (7, 4, 4)
"""Orders of the three channel models, section 6.5.4.2."""


@dataclass(frozen=True)
class Method:
    """An estimator of the Hankel-Toeplitz parameters, and its window p by channel."""

    estimate: Estimator
    p: tuple[int, int, int]


METHODS = {
    "6-7": Method(PRIOR, (38, 42, 39)),
    "6-8": Method(partial(least_squares, tolerance=1e-4), (21, 4, 7)),
}
"""Method of each table.

6-7: p beside the chosen orders in Tables 6-4 to 6-6; 6-8: p of section 6.5.4.3.
"""

TABLES = tuple(METHODS)
"""The tables of this chapter."""

FREQUENCIES = (1, 5, 10)
"""Frequencies of the predicted sines, Hz."""

CHIRP_S, SINE_S = 10.0, 4.0
"""Durations of the chirps and of the sines, s; that of the chirps is not printed."""

CHIRPS = ((20.0, 20.0), (200.0, 0.0), (200.0, 0.0))
SINES = ((10.0, 10.0), (200.0, 0.0), (200.0, 0.0))
"""Amplitude and offset of the command of each channel, um and urad."""

LOOP_WIDTH = 0.01
"""Half width of the hysteresis loop, as a share of the amplitude of the chirp."""


def cells(table: str) -> list[Cell]:
    """Return the 27 cells of ``table`` ("6-7" or "6-8"), simulated.

    The data of the stage are not published, so the printed model (6.23)-(6.25) replaces
    it. Each command passes through a hysteresis of 1 %; each output has the sensor
    noise of the other tables of this stage. Every channel is identified from a linear
    chirp from 1 to 100 Hz and predicts sines of 1, 5 and 10 Hz in a free run. A cell is
    the RMS error over the second half of 4 s. Nothing is tuned for single cells.

    Table 6-7 is the maximum a posteriori estimate ``PRIOR``. Table 6-8 is least squares
    without a prior, for comparison. Taken literally, it fails on a chirp (errors of 1e2
    to 1e8 urad), so the printed method must have been regularised. Here, directions
    weaker than 1e-4 of the strongest are left out. Poles outside the unit circle are
    reflected.

    The driven axes and the order of the two tables can be compared with the thesis. The
    couplings cannot: the printed model is linear, so it has no coupling that a linear
    model fails to predict.
    """
    method = METHODS[table]
    paper = printed("ch6", table)
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
        paper[f"{frequency}Hz_ch{channel + 1}", column].simulated(float(error))
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
    """Return the record of the sensors while ``channel`` follows ``command``."""
    amplitude = CHIRPS[channel][0]
    # Unit slope; the memory of a branch decays within a tenth of the amplitude.
    slope, forgetting = 1.0, 10.0 / amplitude
    hysteresis = ColemanHodgdon(
        a=slope * forgetting,
        b=slope - LOOP_WIDTH * amplitude * forgetting,
        c=-forgetting,
        rest_input=CHIRPS[channel][1],
        rest_output=CHIRPS[channel][1],
        # At 100 Hz a sample is a large step; only the closed form is accurate.
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
