"""Thinning of long curves to what a screen can show."""

import numpy as np
from jaxtyping import Float, Int

PER_COLUMN = 4
"""Samples that are kept of a column: the first, least, greatest and last one."""

GAP = -1
"""Index of a gap in a curve."""


def kept_samples(
    x: Float[np.ndarray, " samples"], y: Float[np.ndarray, " samples"], columns: int
) -> Int[np.ndarray, " kept"]:
    """Return the indices of the samples that draw the curve through (x, y).

    x and y are shares of the drawn range, which is from 0 to 1. If x rises, the range
    is divided into ``columns``. The first, least, greatest and last sample of each are
    kept, which draw the same pixels (M4: Jugel et al., Proc. VLDB Endowment 7, 2014),
    and one sample on each side of the range. Otherwise the curve is a loop. A loop of
    more than ``PER_COLUMN`` times ``columns`` samples keeps only the segments that end
    in a cell of a grid for the first time, with a ``GAP`` where others are left out.
    """
    if np.all(np.diff(x) >= 0.0):
        first = max(np.searchsorted(x, 0.0) - 1, 0)
        shown = slice(first, np.searchsorted(x, 1.0, side="right") + 1)
        return first + _by_column(np.floor(columns * x[shown]), y[shown])
    side, kept = columns, np.arange(x.size)
    while kept.size > PER_COLUMN * columns and side > 1:
        kept = _by_cell(np.floor(side * x), np.floor(side * y))
        side //= 2
    return kept


def _by_column(column: np.ndarray, y: np.ndarray) -> np.ndarray:
    missing = np.isnan(y)
    # A column is split where samples are missing.
    begins = (np.diff(column) != 0.0) | np.diff(missing)
    part = np.concatenate([[0], np.cumsum(begins)])
    first = np.concatenate([[0], 1 + np.flatnonzero(begins)])
    last = np.concatenate([first[1:] - 1, [y.size - 1]])
    order = np.lexsort((y, part))  # the parts stay in place, and y rises in each
    return np.unique(np.concatenate([first, last, order[first], order[last]]))


def _by_cell(column: np.ndarray, row: np.ndarray) -> np.ndarray:
    cells = np.stack([column, row], axis=1)
    ends = np.unique(cells, axis=0, return_index=True)[1]
    drawn = np.unique(np.concatenate([ends, np.maximum(ends - 1, 0)]))
    gaps = 1 + np.flatnonzero(np.diff(drawn) > 1)
    return np.insert(drawn, gaps, GAP)
