"""Model error bound of a plant over frequency."""

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

UNSEEN = 25.0
"""Relative error assumed at frequencies that a record does not excite.

A mode of damping zeta that is not in the model changes the response by the factor
``1 / (2 zeta)`` at its resonance: 25 for a lightly damped stage of 2 %.
"""

NARROW = 0.1
"""Excited band, as a share of the Nyquist frequency, below which a record is narrow."""

WIDTH = 0.01
"""Relative width of the bands of a bound: half the width of a peak of 1 % damping."""

_NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class ErrorBound(BaseModel):
    """Upper bound of the relative error of a model, by frequency.

    ``relative`` bounds ``|G_true / G_model - 1|`` at ``frequency`` (Hz, increasing up
    to the Nyquist frequency). ``excited`` is true for each line at which the record has
    enough power; at the others ``relative`` is an assumption (``UNSEEN``).
    Raises ValueError for lists of different length, and for frequencies that are
    negative or do not increase.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    frequency: tuple[_NonNegative, ...] = Field(min_length=1)
    relative: tuple[_NonNegative, ...]
    excited: tuple[bool, ...]

    @model_validator(mode="after")
    def _consistent(self) -> "ErrorBound":
        lines = len(self.frequency)
        for name in ("relative", "excited"):
            if len(getattr(self, name)) != lines:
                raise ValueError(
                    f"{name} has {len(getattr(self, name))} lines and frequency "
                    f"{lines}; the numbers must be equal"
                )
        if np.any(np.diff(self.frequency) <= 0.0):
            raise ValueError("frequency must increase from line to line")
        return self

    def at(self, frequency: Any) -> np.ndarray:
        """Return the bound at ``frequency`` (Hz): the larger of the neighbouring lines.

        Below the first line it is the bound of the first line, above the last line that
        of the last.
        """
        below, above = self._neighbours(frequency)
        relative = np.asarray(self.relative)
        return np.maximum(relative[below], relative[above])

    @property
    def highest(self) -> float:
        """Highest excited frequency, Hz; 0 if there is none."""
        pairs = zip(self.frequency, self.excited, strict=True)
        return max((line for line, excited in pairs if excited), default=0.0)

    @property
    def narrow(self) -> bool:
        """Whether the record excited less than the share ``NARROW`` of the band."""
        return self.highest < NARROW * self.frequency[-1]

    def respected(self, frequency: np.ndarray) -> np.ndarray:
        """Return the bound ``at`` each ``frequency`` (Hz), 0 above a narrow record.

        Above the band of a narrow record the bound is only an assumption; the remedy is
        another record, not other gains.
        """
        beyond = self.narrow & (frequency > self.highest)
        return np.where(beyond, 0.0, self.at(frequency))

    def supported(self, frequency: np.ndarray) -> np.ndarray:
        """Return the bound for a search, on a grid of equal steps (Hz).

        It is the largest bound within half a step of each ``frequency``, and 0 above a
        narrow record as in ``respected``.
        """
        half = 0.5 * (frequency[1] - frequency[0])
        lines, relative = np.asarray(self.frequency), np.asarray(self.relative)
        ends = np.maximum(self.at(frequency - half), self.at(frequency + half))
        found = np.array(
            [
                np.max(relative[np.abs(lines - f) <= half], initial=end)
                for f, end in zip(frequency, ends, strict=True)
            ]
        )
        return np.where(self.narrow & (frequency + half > self.highest), 0.0, found)

    def excited_at(self, frequency: Any) -> np.ndarray:
        """Return whether both neighbours of ``frequency`` (Hz) are excited."""
        below, above = self._neighbours(frequency)
        excited = np.asarray(self.excited)
        return excited[below] & excited[above]

    def _neighbours(self, frequency: Any) -> tuple[np.ndarray, np.ndarray]:
        lines = np.asarray(self.frequency)
        last = lines.size - 1
        below = np.searchsorted(lines, frequency, side="right") - 1
        above = np.searchsorted(lines, frequency, side="left")
        return np.clip(below, 0, last), np.clip(above, 0, last)


def banded(
    frequency: np.ndarray, relative: np.ndarray, excited: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lines of a bound [lines] merged in bands of ``WIDTH``.

    A band has the largest ``relative`` of its lines, and is excited if all of them are.
    Its frequency is the geometric mean of its ends; that of the last band is the last
    ``frequency``.
    """
    band = np.floor(np.log(frequency / frequency[0]) / np.log1p(WIDTH))
    first = np.flatnonzero(np.diff(band, prepend=-1.0))
    last = np.append(first[1:], band.size) - 1
    middle = np.sqrt(frequency[first] * frequency[last])
    middle[-1] = frequency[-1]
    largest = np.maximum.reduceat(relative, first)
    return middle, largest, np.logical_and.reduceat(excited, first)
