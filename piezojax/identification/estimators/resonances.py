"""Linear dynamics that a record of a hysteretic stage shows: modes, lags, delay.

They are those of the Hammerstein model of its liveliest part (``hammerstein``). A delay
that is negative shows that the output was saved too early.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...core.recipe import Resonance
from .hammerstein import (
    SLOWEST,
    Hammerstein,
    Signals,
    chosen,
    delayed,
    white_error,
    with_lag,
)
from .refined import refined_instrumental_variables
from .slew_rate import CLEAR, has_steps, slew_rate, slewed

SHORTEST = 400
"""Least number of samples from which dynamics are identified."""

LONGEST = 40_000
"""Largest number of samples used; the output moves fastest in those chosen."""

THRESHOLDS = (0.0, *np.geomspace(0.005, 0.4, 7))
"""Thresholds of the plays of the Hammerstein model, shares of the input's range."""

EARLY = 0.4
"""Least samples by which an output is early; records of stages without a delay seemed
0.06 samples early at the most."""

BETTER = 0.9
"""Factor by which delaying an early output lowers the white error; that of an output
saved in time went to 0.92 of itself at the least."""

LATER = 3
"""Number of samples by which an output is delayed to see whether it is early."""


class LinearDynamics(NamedTuple):
    """Resonances, strongest first, time constants of lags (s) and the delay (s).

    ``delay`` is in excess of the one sample between input and output, and negative if
    the output answers sooner. ``slope`` is that of the output over the full range of
    the input, below the resonances. Both are None if no dynamics could be identified.
    ``whitening`` is the filter of the errors. ``slew`` is the slew rate of the input in
    ``input_unit`` per s, None if the input shows no limit.
    """

    modes: tuple[Resonance, ...] = ()
    lags: tuple[float, ...] = ()
    delay: float | None = None
    slope: float | None = None
    whitening: tuple[float, ...] = ()
    slew: float | None = None
    input_unit: str = "V"

    def __str__(self) -> str:
        texts = [
            f"a resonance at {mode.frequency:.4g} Hz with a damping of "
            f"{100.0 * mode.damping:.2g} %"
            for mode in self.modes
        ]
        texts += [f"a lag of {1e3 * lag:.2g} ms" for lag in self.lags]
        if self.slew is not None:
            texts.append(f"a slew rate of {self.slew:.3g} {self.input_unit}/s")
        return ", ".join(texts)


_Found = tuple[LinearDynamics, Hammerstein | None]
"""What a record shows, and the model that shows it."""


def linear_dynamics(input: np.ndarray, output: np.ndarray, dt: float) -> LinearDynamics:
    """Return the linear dynamics that ``input`` and ``output`` [samples] show.

    ``dt`` in s. Signals that are too short or do not excite dynamics show none. The
    last few results are kept, because several parts of a fit need the same ones.
    """
    return _found(input, output, dt)[0]


def _found(input: np.ndarray, output: np.ndarray, dt: float) -> _Found:
    signals = (np.asarray(signal, float).tobytes() for signal in (input, output))
    return _found_once(*signals, dt)


@lru_cache(maxsize=4)
def _found_once(input: bytes, output: bytes, dt: float) -> _Found:
    x, y = _liveliest(np.frombuffer(input), np.frombuffer(output))
    if x.size < SHORTEST:
        return LinearDynamics(), None
    moved = _above_slowest(y)
    # The plays take long, and fast motions show the rate without them.
    rate = slew_rate(x, lambda slewed: _simple_cost(slewed, moved))
    found, model = _behind(x if rate is None else slewed(x, rate), moved, dt)
    if rate is not None and not has_steps(x):
        # Further modes and lags may explain as much as the slew rate does. A record
        # without a resonance does not tell it from a hysteresis.
        plain, without = _behind(x, moved, dt)
        if not plain.modes or not _clearly_better(model, without):
            return plain, without
    return found._replace(slew=None if rate is None else rate / dt), model


def _behind(x: np.ndarray, moved: np.ndarray, dt: float) -> _Found:
    """Return what ``x``, behind the amplifier, and the output ``moved`` show."""
    slopes = 1.0 - 2.0 * np.array(THRESHOLDS)
    return _shown(Signals(_play_outputs(x), slopes, moved), dt)


def _clearly_better(model: Hammerstein | None, without: Hammerstein | None) -> bool:
    if model is None or without is None:
        return False
    return white_error(model) < CLEAR * white_error(without)


def _simple_cost(x: np.ndarray, moved: np.ndarray) -> float:
    """Return the white error of a mode and a lag behind ``x``."""
    try:
        model = refined_instrumental_variables(_above_slowest(x), moved, 3, 3)
    except (ValueError, np.linalg.LinAlgError):
        return np.inf
    return float(np.sqrt(model.cost))


def slew_behind(
    front_of: Callable[[np.ndarray], np.ndarray],
    input: np.ndarray,
    output: np.ndarray,
    dt: float,
) -> float | None:
    """Return the slew rate (unit of ``input`` per s) that steps show, or None.

    ``front_of`` is the fitted hysteresis behind the amplifier, from its input to its
    output [samples].
    """
    if not has_steps(input):
        return None
    moved = _above_slowest(output)
    rate = slew_rate(input, lambda slewed: _simple_cost(front_of(slewed), moved))
    return None if rate is None else rate / dt


def samples_early(input: np.ndarray, output: np.ndarray, dt: float) -> float:
    """Return by how many samples ``output`` [samples] answers too soon, 0 if it is not.

    In a loop the output of a sample is read before the input acts, so that no delay is
    negative. The models have no room for one, which biases them or makes them worse. So
    an output is early if its delay is negative, or a model fits it much better when it
    is delayed by ``LATER`` samples; the model of the delayed output must then have a
    shorter delay than these. Nothing is found without a resonance.
    """
    shown, model = _found(input, output, dt)
    if model is None:
        return 0.0
    signals = model.signals.later(LATER)
    later = with_lag(signals, max(1, len(shown.modes)))
    if later is None:
        return 0.0
    later = delayed(signals, later)
    modes = later.modes(dt)
    if not modes:
        return 0.0
    early = LATER - later.extra_delay(modes, later.lags(dt), dt) / dt
    negative = bool(shown.modes) and (shown.delay or 0.0) < -EARLY * dt
    better = white_error(later) < BETTER * white_error(model)
    return early if early > EARLY and (negative or better) else 0.0


def dynamics_behind(front: np.ndarray, output: np.ndarray, dt: float) -> LinearDynamics:
    """Return the linear dynamics between ``front`` and ``output`` [samples].

    ``front`` is the output of a fitted hysteresis under the input of the record. It
    replaces the few plays of ``linear_dynamics``, whose errors hide a weak mode. The
    slope found is that over ``front``.
    """
    x, y = _liveliest(front, output)
    if x.size < SHORTEST:
        return LinearDynamics()
    signals = Signals(
        _above_slowest(x)[None], np.ones(1), _above_slowest(y), fitted=True
    )
    return _shown(signals, dt)[0]


def _shown(signals: Signals, dt: float) -> _Found:
    try:
        model = chosen(signals)
    except (ValueError, np.linalg.LinAlgError):
        return LinearDynamics(), None
    modes, lags = model.modes(dt), model.lags(dt)
    delay = model.extra_delay(modes, lags, dt)
    whitening = tuple(map(float, model.dynamics.noise))
    return LinearDynamics(modes, lags, delay, model.slope(), whitening), model


def _liveliest(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the LONGEST consecutive samples in which the output moves fastest."""
    if x.size <= LONGEST:
        return x, y
    energy = np.cumsum(np.r_[0.0, np.diff(y, prepend=y[0]) ** 2])
    first = int(np.argmax(energy[LONGEST:] - energy[:-LONGEST]))
    return x[first : first + LONGEST], y[first : first + LONGEST]


def _play_outputs(x: np.ndarray) -> np.ndarray:
    """Return the outputs of plays [plays, samples] above the slowest frequencies."""
    thresholds = np.ptp(x) * np.array(THRESHOLDS)
    memory = np.full(thresholds.size, x[0])
    outputs = np.empty((x.size, thresholds.size))
    for k, value in enumerate(x):
        memory = np.clip(memory, value - thresholds, value + thresholds)
        outputs[k] = memory
    return np.stack([_above_slowest(column) for column in outputs.T])


def _above_slowest(signal: np.ndarray) -> np.ndarray:
    import scipy.signal  # takes long to import

    sections = scipy.signal.butter(2, 2.0 * SLOWEST, "high", output="sos")
    return np.asarray(scipy.signal.sosfilt(sections, signal - signal[0]))
