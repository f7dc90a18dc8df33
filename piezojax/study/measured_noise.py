"""Measured noise and vibrations in files: random draws, or sections of a record."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from .file_tables import NoiseFile
from .schema import Study
from .signal_files import FileSignals, read_densities, read_signals

SEGMENTS = 8
"""Ratio of the length of a record to that of a segment in Welch's method."""

SHORTEST = 512
"""Least number of samples of a record of noise."""

SAME = 1e-3
"""Largest relative difference of two sampling rates that count as equal."""

HIGHEST = 0.9
"""Share of half the rate up to which the noise of a sensor must be known."""

FINER = 8
"""Factor by which a record is oversampled before its linear interpolation."""

STEADY = 2.0
"""Ratio of the rms values of both halves of a record above which a note warns."""


class Density(NamedTuple):
    """One-sided power spectral densities of noise, by axis.

    ``frequency`` [lines] in Hz increases from above 0; ``levels`` [lines, axes] are in
    the square of the axis's unit over Hz. Between two lines log(level) is linear in
    log(frequency). Below the first line its level holds; above the last one there is no
    noise.
    """

    frequency: Float[np.ndarray, " lines"]
    levels: Float[np.ndarray, "lines axes"]

    def at(self, frequency: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """Return the levels at frequencies above 0, Hz."""
        known = np.log(np.maximum(self.levels, np.finfo(float).tiny))
        place = np.log(np.maximum(frequency, self.frequency[0]))
        lines = np.log(self.frequency)
        found = [np.interp(place, lines, axis) for axis in known.T]
        beyond = frequency > self.frequency[-1] * (1.0 + 1e-9)
        return np.where(beyond[:, None], 0.0, np.exp(np.stack(found, axis=1)))

    def sampled(
        self, frequency: Float[np.ndarray, " n"], rate: float
    ) -> Float[np.ndarray, "n axes"]:
        """Return the levels of the noise sampled at ``rate`` (Hz).

        Noise above half the rate is aliased.
        """
        found = self.at(frequency)
        for image in range(1, int(np.ceil(self.frequency[-1] / rate)) + 1):
            found = found + self.at(image * rate - frequency)
            found = found + self.at(image * rate + frequency)
        return found


@dataclass(frozen=True)
class MeasuredNoise:
    """Noise of a file at the rate of a study, in the units of its axes.

    ``density`` gives random draws, ``record`` [samples, axes] sections; one of them is
    None. ``rms`` [axes] is that of the whole noise; ``note`` describes its source and
    its conversion.
    """

    rate: float
    rms: Float[np.ndarray, " axes"]
    note: str
    density: Density | None = None
    record: Float[np.ndarray, "samples axes"] | None = None

    def draws(
        self,
        random: np.random.Generator,
        shape: tuple[int, ...],
        samples: int,
        part: Literal["train", "validate"],
    ) -> Float[np.ndarray, "*shape samples axes"]:
        """Return noise for the runs of ``shape``, of ``samples`` each.

        Draws are Gaussian with the density of the file: each line of their spectrum is
        an independent complex normal number (J. Timmer and M. Koenig, Astronomy and
        Astrophysics 300 (1995) 707). Sections begin at random samples of the first half
        of a record for the ``part`` "train", of the second for "validate".
        """
        if self.record is not None:
            half = len(self.record) // 2
            first = 0 if part == "train" else half
            begins = first + random.integers(0, half - samples + 1, shape)
            return self.record[begins[..., None] + np.arange(samples)]
        lines, points = _lines(samples, self.rate)
        assert self.density is not None
        levels = self.density.sampled(lines, self.rate).T  # [axes, lines]
        size = np.sqrt(levels * self.rate * points / 4.0)
        normal = random.standard_normal((2, *shape, *levels.shape))
        spectrum = np.zeros((*shape, len(levels), lines.size + 1), complex)
        spectrum[..., 1:] = size * (normal[0] + 1j * normal[1])
        # The last line is real, and counts once.
        spectrum[..., -1] = np.sqrt(2.0) * size[:, -1] * normal[0][..., -1]
        drawn = np.fft.irfft(spectrum, points)[..., :samples]
        return np.moveaxis(drawn, -2, -1)


def _lines(samples: int, rate: float) -> tuple[Float[np.ndarray, " lines"], int]:
    """Return the lines (Hz) of a period of at least twice ``samples``, and its length.

    A draw is a part of this period, so that its two ends are not correlated.
    """
    points = 2 * scipy.fft.next_fast_len(samples, real=True)
    return np.arange(1, points // 2 + 1) * rate / points, points


def read_noise(
    table: NoiseFile,
    study: Study,
    folder: Path,
    where: str,
    units: Sequence[str],
    *,
    sensor: bool = False,
) -> MeasuredNoise:
    """Return the noise of ``table`` in ``units``; ``where`` is its key in ``study``.

    The noise of a ``sensor`` must be known up to nearly half the rate of the study.
    Raises ValueError, starting with ``where``, for a file that cannot be read, is too
    short, or does not cover the band.
    """
    if table.frequency is not None:
        density = Density(*read_densities(table, study, folder, where, units))
        known, note = density.frequency[-1], f"the spectrum of {table.file.name}"
        _check_band(known, study, where, sensor)
        return _drawn(density, study, f"{where}: random draws with {note}", known)
    signals = read_signals(table, study, folder, where, units)
    values = signals.values - signals.values.mean(axis=0)
    if len(values) < SHORTEST:
        raise ValueError(
            f"{where}: {table.file.name} has {len(values)} samples; at least "
            f"{SHORTEST} are needed"
        )
    for name, rms in zip(signals.columns, values.std(axis=0), strict=True):
        if name and rms == 0.0:
            raise ValueError(f"{where}: column {name!r} never changes")
    known = 0.5 / signals.dt
    _check_band(known, study, where, sensor)
    unsteady = _unsteady(values, signals)
    if table.play == "record":
        found = _played(values, signals, table, study, where)
    else:
        length = len(values) // SEGMENTS
        frequency, levels = scipy.signal.welch(
            values, 1.0 / signals.dt, nperseg=length, axis=0
        )
        count = (len(values) - length) // (length - length // 2) + 1
        low, high = confidence(count)
        note = (
            f"{where}: random draws with the spectrum of {len(values)} samples of "
            f"{table.file.name} at {1.0 / signals.dt:.6g} Hz, by Welch's method with "
            f"{count} segments of {length} samples (95 % interval of its level: "
            f"{low:.2g} to {high:.2g} times)"
        )
        found = _drawn(Density(frequency[1:], levels[1:]), study, note, known)
    return MeasuredNoise(
        found.rate, found.rms, found.note + unsteady, found.density, found.record
    )


def confidence(segments: int) -> tuple[float, float]:
    """Return the factors on a level by Welch's method that bound its 95 % interval.

    They are those of chi-squared with 36 n^2 / (19 n - 1) degrees of freedom, for n
    segments with Hann windows that overlap by half (Percival and Walden, Spectral
    Analysis for Physical Applications, 1993, 6.17).
    """
    degrees = 36.0 * segments**2 / (19.0 * segments - 1.0)
    high, low = degrees / scipy.stats.chi2.ppf([0.025, 0.975], degrees)
    return float(low), float(high)


def _check_band(known: float, study: Study, where: str, sensor: bool) -> None:
    """Raise ValueError if the noise of a sensor is not known up to half the rate."""
    if sensor and known < HIGHEST * 0.5 * study.rate:
        raise ValueError(
            f"{where}: the file covers no frequency above {known:.6g} Hz, and the "
            f"sensor is sampled at {study.rate:g} Hz: measure its noise up to "
            f"{0.5 * study.rate:g} Hz"
        )


def _drawn(density: Density, study: Study, note: str, known: float) -> MeasuredNoise:
    samples = round(study.references.duration * study.rate)
    lines, points = _lines(samples, study.rate)
    levels = density.sampled(lines, study.rate)
    levels[-1] *= 0.5
    rms = np.sqrt(np.sum(levels, axis=0) * study.rate / points)
    if not np.any(rms > 0.0):
        raise ValueError(f"{note}: the noise is zero")
    return MeasuredNoise(study.rate, rms, note + _band(known, study), density)


def _played(
    values: Float[np.ndarray, "samples axes"],
    signals: FileSignals,
    table: NoiseFile,
    study: Study,
    where: str,
) -> MeasuredNoise:
    """Return the noise that plays ``values`` at the rate of the study."""
    rate = 1.0 / signals.dt
    note = (
        f"{where}: sections of the {len(values)} samples of {table.file.name} at "
        f"{rate:.6g} Hz, of the first half in tuning, of the second in the hold-out"
    )
    values, done = _at_rate(values, rate, study.rate)
    note += done
    needed = round(study.references.duration * study.rate)
    if len(values) // 2 < needed:
        raise ValueError(
            f"{where}: half of {table.file.name} lasts {0.5 * signals.duration:.6g} s, "
            f"and the references last {study.references.duration:g} s: record longer, "
            'or set play = "spectrum"'
        )
    note += _band(0.5 * rate, study)
    return MeasuredNoise(study.rate, values.std(axis=0), note, record=values)


def _at_rate(
    values: Float[np.ndarray, "samples axes"], rate: float, wanted: float
) -> tuple[Float[np.ndarray, "resampled axes"], str]:
    """Return ``values`` of ``rate`` (Hz) at the ``wanted`` rate, and a part of a note.

    If ``rate`` is n times the wanted one, every n-th sample is taken. Otherwise the
    band-limited signal is interpolated between the samples.
    """
    every = round(rate / wanted)
    if every and abs(rate / wanted / every - 1.0) < SAME:
        return values[::every], "" if every == 1 else f", every {every}th sample"
    fine = scipy.signal.resample_poly(values, FINER, 1, axis=0)
    count = int((len(values) - 1) * wanted / rate) + 1
    places = np.arange(count) * rate / wanted * FINER
    grid = np.arange(len(fine))
    found = np.stack([np.interp(places, grid, column) for column in fine.T], axis=1)
    return found, f", interpolated at {wanted:g} Hz"


def _band(known: float, study: Study) -> str:
    """Return the part of a note on frequencies that are missing or aliased."""
    nyquist = 0.5 * study.rate
    if known < nyquist * (1.0 - SAME):
        return (
            f"; the file covers no frequency above {known:.6g} Hz, so that there is no "
            "noise above it"
        )
    if known > nyquist * (1.0 + SAME):
        return f"; noise above {nyquist:g} Hz is aliased, as by a converter"
    return ""


def _unsteady(values: Float[np.ndarray, "samples axes"], signals: FileSignals) -> str:
    half = len(values) // 2
    for name, column in zip(signals.columns, values.T, strict=True):
        sizes = column[:half].std(), column[half:].std()
        if name and max(sizes) > STEADY * min(sizes):
            return (
                f"; {name!r} is not stationary: its halves have the rms values "
                f"{sizes[0]:.3g} and {sizes[1]:.3g}"
            )
    return ""
