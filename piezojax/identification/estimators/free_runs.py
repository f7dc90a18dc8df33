"""Free runs: the output that a System predicts from the input alone."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import ScalarLike, as_array
from ...core.system import System, at_rest, resolve
from ...engines import run_outputs
from ..records.record import Record
from .approach import TURNS, input_before
from .linear_start import Start
from .start_search import start_after, start_of

REACHED, LATEST = 0.9, 0.7
"""Share of the range of an input after which its earlier motions are mostly forgotten,
and largest share of a record that is left out for this."""


def free_run(
    system: System, input: Float[Array, "n ..."], before: ScalarLike | Array
) -> Float[Array, "n ..."]:
    """Return the output samples that ``system`` predicts from ``input`` alone.

    A plant maps u(k) to y(k+1), as in the loop; the first output is that at rest under
    ``before``, the input in force when the record begins.
    """
    system = resolve(system)  # once for the start and the run
    state, first = at_rest(system, before)
    return jnp.concatenate([first[None], run_outputs(system, input, state)[:-1]])


def from_rest(system: System, input: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Return the free run from rest under the input before it (``input_before``).

    It is the first input by default.
    """
    return free_run(system, input, input_before(system, input[0]))


def starts_of(
    system: System, records: Sequence[Record], train: slice
) -> tuple[list[Start], list[np.ndarray], list[float]]:
    """Return starts, runs [samples, 1] and zeros of the sensor, one for each record.

    The starts are estimated for ``system`` on the samples ``train``.
    """
    ends = _ends(records)
    found, runs, zeros = [], [], []
    for record in records:
        part = slice(train.start, min(train.stop, record.samples))
        start, run, zero = start_of(system, record.input, record.output, part, ends)
        found.append(start)
        runs.append(run)
        zeros.append(float(zero[0]))
    return found, runs, zeros


def _ends(records: Sequence[Record]) -> np.ndarray:
    return np.array([f([f(r.input) for r in records]) for f in (np.min, np.max)])


def first_covering(inputs: Float[np.ndarray, "n m"], share: float) -> int:
    """Return the sample from which each input has covered ``share`` of its range.

    It is 0 without such a sample.
    """
    reached = np.maximum.accumulate(inputs) - np.minimum.accumulate(inputs)
    enough = np.all(reached >= share * np.ptp(inputs, axis=0), axis=1)
    return int(np.argmax(enough))


def settled_part(input: np.ndarray, train: slice) -> slice:
    """Return the samples of ``train`` that depend little on the state before them.

    Most turning points of an earlier motion are forgotten once ``input`` [samples] has
    moved over REACHED of its range, at the latest after LATEST of the samples.
    """
    seen = input[train]
    first = first_covering(seen[:, None], REACHED)
    return slice(train.start + min(first, int(LATEST * seen.size)), train.stop)


def settled_starts(
    system: System, records: Sequence[Record], parts: Sequence[slice]
) -> list[Start]:
    """Return starts at rest under the first input, one for each record.

    The linear states follow from the samples ``parts`` of each record.
    """
    ends = _ends(records)
    return [
        start_after(
            system, r.input, r.output, part, ends, np.repeat(r.input[0], TURNS)
        )[0]
        for r, part in zip(records, parts, strict=True)
    ]


def free_runs(
    system: System,
    records: Sequence[Record],
    train: slice,
    *,
    own_starts: bool = False,
) -> tuple[tuple[np.ndarray, ...], list[float]]:
    """Return the free run [samples, 1] of each of ``records``, and their zeros.

    A single record begins at rest and has no zero of its own. With several records, or
    with ``own_starts``, their starts and zeros are estimated on the samples ``train``.
    """
    if own_starts or len(records) > 1:
        _, runs, zeros = starts_of(system, records, train)
        return tuple(runs), zeros
    run = eqx.filter_jit(from_rest)
    return tuple(
        np.asarray(run(system, as_array(r.input)))[:, None] for r in records
    ), [0.0]
