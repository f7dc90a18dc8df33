"""Hammerstein model of a record: plays followed by a transfer function.

Both are fitted in turn to the signals above the slowest frequencies. The order rises as
long as a further mode or lag clearly lowers the white error; resonances and lags follow
from the poles.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...core.recipe import Resonance
from .further_mode import with_further_mode
from .refined import TransferFunction, refined_instrumental_variables

ROUNDS = 3
"""Number of times that the plays and the transfer function are fitted in turn."""

SLOWEST = 2e-3
"""Corner of the high-pass filter against creep and drift, cycles per sample."""

LAGS, DELAYS = 1, 6
"""Most lags of a model, and longest delay in samples."""

DROPS = (0.99, 0.95)
"""Factors by which the first and the second mode must lower the white error to count. A
harmonic of the hysteresis near the first resonance looks like a second, weak one."""

EVIDENCE = 20.0
"""Least rise of the log likelihood by a mode: in a short record a smaller rise occurs
by chance."""

NEGLIGIBLE = 1e-6
"""White error, as a share of the output, below which no further mode is tried."""

LAG_DROP = 0.995
"""Factor by which a lag or a sample of delay must lower the white error."""

DIPOLE = 1.0
"""Distance, as a share of a pole's distance from 1, within which a zero cancels a
lag."""

HIGHEST = 0.45
"""Largest frequency of a mode, cycles per sample."""

DAMPED = 0.5
"""Damping ratio above which a pair of poles is not a resonance."""

WHOLE = 0.1
"""Least static gain of all modes together, as a share of the response at the slowest
frequencies. The stage moves through its modes, so that the share is near 1, or a third
behind a lag too short to be found. That of poles beside zeros, which fit only noise, is
a few hundredths."""

EXPLAINED = 0.02
"""Least share of the output's power, in the octave around a mode, that the model of
the record explains."""


class Signals(NamedTuple):
    """Outputs of the plays [plays, samples] and of the stage [samples], filtered.

    ``slopes`` [plays] are those of the plays over the full range of the input. If
    ``fitted``, the output of a fitted hysteresis takes the place of the plays.
    """

    plays: np.ndarray
    slopes: np.ndarray
    output: np.ndarray
    fitted: bool = False

    def later(self, samples: int) -> "Signals":
        """Return the signals with the output delayed by ``samples``."""
        before = np.full(samples, self.output[0])
        return self._replace(output=np.r_[before, self.output[:-samples]])


class Hammerstein(NamedTuple):
    """Plays with ``weights`` and a transfer function, fitted to the ``signals``."""

    signals: Signals
    weights: np.ndarray
    dynamics: TransferFunction

    def modes(self, dt: float) -> tuple[Resonance, ...]:
        """Return the resonances that the record shows, strongest first."""
        found, gains = [], self._static_gains()
        for pole, gain in gains.items():
            rate = np.log(pole)
            cycles, damping = abs(rate) / (2.0 * np.pi), -np.real(rate) / abs(rate)
            if not (0.0 < cycles < HIGHEST and damping < DAMPED):
                continue
            if self._explained(cycles) > EXPLAINED:
                peak = abs(self.dynamics.response(np.array([cycles]))[0])
                found.append((peak, cycles / dt, damping, gain))
        whole = sum(gain for *_, gain in found)
        slow = self.dynamics.response(np.array([SLOWEST]))[0]
        if abs(whole) < WHOLE * abs(slow):
            return ()
        return tuple(
            Resonance(float(frequency), float(damping), float(gain / whole))
            for _, frequency, damping, gain in sorted(found, reverse=True)
        )

    def _static_gains(self) -> dict[complex, float]:
        """Return the static gain of each pair of complex poles, by its upper pole.

        The step response of a mode (poles p and conj(p) in the s plane) in series with
        lags (poles r) has at p the residue ``gain w^2 / ((p - conj(p)) p)`` divided by
        ``prod (1 - p / r)``. The discrete transfer function over z - 1 has the same
        residue.
        """
        poles, slow = self.dynamics.poles(), self._real_rates()
        upper = poles[np.imag(poles) > 1e-9]
        found = {}
        for pole in upper:
            rate, others = np.log(pole), poles[poles != pole]
            residue = np.polyval(self.dynamics.numerator[::-1], 1.0 / pole) * pole
            residue = residue / np.prod(1.0 - others / pole) / (pole - 1.0)
            own = abs(rate) ** 2 / ((rate - np.conj(rate)) * rate)
            found[complex(pole)] = residue / own * np.prod(1.0 - rate / slow)
        if not found:
            return {}
        # All modes share the delay of the strongest, whose gain has the slope's sign.
        strongest = max(found, key=lambda pole: abs(found[pole]))
        sign = np.sign(self.slope()) or 1.0
        delay = -np.angle(sign * found[strongest]) / np.angle(strongest)
        return {
            pole: float(abs(gain) * np.sign(np.real(gain * pole**delay)))
            for pole, gain in found.items()
        }

    def _explained(self, cycles: float) -> float:
        """Return the explained share of the output in the octave around ``cycles``."""
        model = self.dynamics.applied(self.weights @ self.signals.plays)
        output = self.signals.output
        line = np.fft.rfftfreq(output.size)
        near = (line > cycles / np.sqrt(2.0)) & (line < cycles * np.sqrt(2.0))
        left, all_ = (
            np.sum(np.abs(np.fft.rfft(signal)[near]) ** 2)
            for signal in (output - model, output)
        )
        return float(1.0 - left / all_)

    def lags(self, dt: float) -> tuple[float, ...]:
        """Return the time constants (s) of the real poles, longest first.

        A pole with a zero beside it, or below the high-pass filter, is creep or an
        error of the hysteresis.
        """
        return tuple(float(-dt / rate) for rate in self._real_rates())

    def _real_rates(self) -> np.ndarray:
        """Return the poles of the lags in the s plane, per sample, slowest first."""
        poles, zeros = self.dynamics.poles(), np.roots(self.dynamics.numerator)
        real = np.real(poles[(np.abs(np.imag(poles)) < 1e-9) & (np.real(poles) > 0.0)])
        kept = [
            pole
            for pole in sorted(real, reverse=True)
            if np.all(np.abs(zeros - pole) > DIPOLE * (1.0 - pole))
            and 1.0 - pole > 2.0 * np.pi * SLOWEST
        ]
        return np.log(np.array(kept))

    def slope(self) -> float:
        """Return the mean slope over the full range at the slowest frequencies."""
        moved = self.weights @ self.signals.slopes
        slow = self.dynamics.response(np.array([SLOWEST]))[0]
        return float(moved * abs(slow) * np.sign(np.real(slow)))

    def extra_delay(
        self, modes: tuple[Resonance, ...], lags: tuple[float, ...], dt: float
    ) -> float:
        """Return the delay (s) that explains the phase beyond that of modes and lags.

        The response of modes and lags is that to a held input.
        """
        highest = max([0.2, *(1.2 * mode.frequency * dt for mode in modes)])
        cycles = np.linspace(3.0 * SLOWEST, min(highest, HIGHEST), 400)
        turn = np.exp(-2j * np.pi * cycles)
        slow = [complex(-1.0 / lag) for lag in lags]
        held = sum(
            (mode.share * _held([*mode.poles, *slow], dt, turn) for mode in modes),
            np.zeros(cycles.size) if modes else _held(slow, dt, turn),
        )
        rest = self.dynamics.response(cycles) / turn / held
        phase = np.unwrap(np.angle(rest * np.sign(np.real(rest[0]))))
        return float(-(phase @ cycles) / (2.0 * np.pi * cycles @ cycles) * dt)


def _held(rates: Sequence[complex], dt: float, turn: np.ndarray) -> np.ndarray:
    """Return the response, of unit DC gain, to a held input at the end of the sample.

    ``rates`` are the poles in the s plane (1/s), ``turn`` is exp(-2 pi i f dt).
    """
    steps = 1.0 / (1.0 - turn)
    for i, rate in enumerate(rates):
        others = [other for j, other in enumerate(rates) if j != i]
        residue = -np.prod([other / (other - rate) for other in others])
        steps = steps + residue / (1.0 - np.exp(rate * dt) * turn)
    return steps * (1.0 - turn) / turn


def _fitted(
    signals: Signals,
    modes: int,
    lags: int,
    delay: int = 1,
    start: Hammerstein | None = None,
) -> Hammerstein | None:
    """Return the model of this order, or None if the record does not determine it.

    The fit begins at ``start``, a model of the same order, if there is one.
    """
    poles = 2 * modes + lags
    orders = (poles, max(1, poles), delay)
    model = start
    weights = np.eye(len(signals.plays))[0] if start is None else start.weights
    for _ in range(ROUNDS):
        known = None if model is None else model.dynamics
        x = weights @ signals.plays
        try:
            found = refined_instrumental_variables(
                x, signals.output, *orders, known, differences=signals.fitted
            )
        except (ValueError, np.linalg.LinAlgError):
            return None
        model = Hammerstein(signals, weights, found)
        columns = [found.whitened(found.applied(play)) for play in signals.plays]
        output = found.whitened(signals.output)
        weights = np.linalg.lstsq(np.stack(columns, 1), output, rcond=None)[0]
    return model


def white_error(model: Hammerstein | None) -> float:
    """Return the rms of the white errors of a model."""
    return np.inf if model is None else float(np.sqrt(model.dynamics.cost))


def with_lag(signals: Signals, modes: int, delay: int = 1) -> Hammerstein | None:
    """Return the model with as many lags as lower the error."""
    best = None
    for lags in range(LAGS + 1):
        model = _fitted(signals, modes, lags, delay)
        if best is None or white_error(model) < LAG_DROP * white_error(best):
            best = model
    return best


def _with_mode(model: Hammerstein) -> Hammerstein | None:
    """Return ``model`` with one more mode, fitted from the one that it lacks most."""
    poles = model.dynamics.poles().size
    if not poles:
        return None
    signals = model.signals
    moved = model.weights @ signals.plays
    wider = with_further_mode(model.dynamics, moved, signals.output)
    start = model._replace(dynamics=wider)
    return _fitted(signals, poles // 2 + 1, poles % 2, wider.delay, start)


def chosen(signals: Signals) -> Hammerstein:
    """Return the model with as many modes as lower the error.

    Behind a fitted hysteresis the modes that the errors show are tried as well. Errors
    of the plays look like weak modes.
    """
    best = with_lag(signals, 0)
    chance = np.exp(-EVIDENCE / signals.output.size)
    for modes, drop in enumerate(DROPS, 1):
        if white_error(best) < NEGLIGIBLE * np.std(signals.output):
            break
        model = with_lag(signals, modes)
        if signals.fitted and best is not None:
            model = min(model, _with_mode(best), key=white_error)
        shown = model is not None and len(model.modes(1.0)) == modes
        if not shown or white_error(model) > min(drop, chance) * white_error(best):
            break
        best = model
    if best is None:
        raise ValueError("the record does not determine any dynamics")
    return delayed(signals, best)


def delayed(signals: Signals, model: Hammerstein) -> Hammerstein:
    """Return ``model`` with the delay that lowers its error most."""
    best, poles = model, model.dynamics.poles().size
    for delay in range(2, DELAYS + 1):
        later = _fitted(signals, poles // 2, poles % 2, delay)
        if later is None or white_error(later) > LAG_DROP * white_error(best):
            break
        best = later
    return best
