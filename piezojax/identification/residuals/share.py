"""Outputs of a record that a model does not explain."""

from collections.abc import Sequence

import numpy as np

from ..estimators.projection import motion
from ..records.record import Record

POOR = 0.2
"""Validation error, as a share of the output's deviation, above which to warn."""

NOISE = 1.5
"""Ratio to white noise of the same differences above which an output of several has
motion that a model should explain."""


def unexplained_outputs(
    records: Sequence[Record], runs: Sequence[np.ndarray], part: slice
) -> list[str]:
    """Return a sentence for each output that the free ``runs`` explain poorly.

    The runs are [samples, p] for each record; they are compared over ``part``.
    """
    errors = np.concatenate(
        [
            # In a closed loop drift is no error of the model.
            motion(r, run - r.outputs, part)
            if r.excitation.size
            else (run - r.outputs)[part]
            for r, run in zip(records, runs, strict=True)
        ]
    )
    outputs = np.concatenate([motion(r, r.outputs, part) for r in records])
    shares = unexplained_shares(errors, outputs)
    moves = _moves(outputs) if shares.size > 1 else [True]
    return [
        f"the model explains little{of_output(i, shares.size)}: its validation error "
        f"is {100.0 * share:.0f} % of the output's own deviation"
        for i, (share, moved) in enumerate(zip(shares, moves, strict=True))
        if share > POOR and moved
    ]


def _moves(outputs: np.ndarray) -> np.ndarray:
    """Return whether each of ``outputs`` [samples, p] does more than white noise."""
    noise = np.std(np.diff(outputs, axis=0), axis=0) / np.sqrt(2.0)
    return np.std(outputs, axis=0) > NOISE * noise


def unexplained_shares(errors: np.ndarray, outputs: np.ndarray) -> np.ndarray:
    """Return the rms of each of ``errors`` over the deviation of its output, [p].

    Both are [samples, p]; one output may move less than another, or in another unit.
    """
    deviations = np.std(outputs, axis=0)
    return np.sqrt(np.mean(errors**2, axis=0)) / np.maximum(deviations, 1e-30)


def of_output(output: int, outputs: int) -> str:
    """Return the words that name one of several outputs; none for the only one."""
    return f" of output {output}" if outputs > 1 else ""
