"""Default model: the hysteresis that describes a record best, and its dynamics."""

import contextlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..core.arrays import as_array
from ..core.progress import Progress, Silent
from ..hysteresis.model import hystereses
from .chain import dynamics_of, dynamics_parts, structure
from .estimators.free_runs import from_rest
from .estimators.output_error import Optimum, leading, output_error
from .estimators.structure import Structure
from .held_dynamics import HeldDynamics
from .records.record import Record
from .second_sight import Begun, seen_again, seen_behind

HYSTERESES = (
    "shaped_coleman_hodgdon",
    "asymmetric_prandtl_ishlinskii",
    "normalised_bouc_wen",
)
"""Hysteresis models to choose from, the one with the fewest parameters first. They
represent three classes of loops: around an anhysteretic curve, with a memory that is
wiped out, and with a memory that decays along the input."""

PLAYS = HYSTERESES[1]
"""The one of them behind which the dynamics are looked at."""

FROM_SEVERAL = (*HYSTERESES[:2], "dahl_frictions")
"""The same for several records: they determine the bends of several frictions."""

DENSITY = "preisach"
"""Model of several records if its error is clearly smaller than that of the best other
one: a density describes many loops."""

EVERY = (*FROM_SEVERAL, DENSITY)
"""All models that are fitted to several records."""

CREEP = "exponential_creep"
"""Creep of the default model."""

LOOKS = 1
"""Looks at the dynamics behind the hysteresis before the choice."""

CLEARLY = 0.8
"""Ratio to the error of the first model below which another one is chosen."""

LEAST, SAMPLES, MOST = 1000, 4000, 100_000
"""Numbers of samples: least number from which a hysteresis is chosen, least number of a
trial, and number of a trial from which VARIATION no longer raises the rate."""

VARIATION = 0.95
"""Share of the total variation of the input that a lower rate must keep: the state of a
hysteresis depends on every motion, the fast ones included."""

RESOLVED = 8.0
"""Least number of samples in a period of the fastest resonance in a trial."""

STEPS, PASSES, LATER_PASSES = 24, 3, 8
"""Number of steps of each fit of a trial; number of its fits to several records at
first, and most further ones of those that are ``CLOSE``."""

CLOSE = 4.0
"""Ratio to the least error below which the first fits do not decide: those of frictions
and of many plays converge slowly."""


class Chosen(NamedTuple):
    """A chain or a hysteresis by name, and its fit to several records, if there is one.

    The fit includes the dynamics that show behind its hysteresis.
    """

    model: str
    begun: Begun | None


def automatic(
    record: Record,
    progress: Progress | None = None,
    beside: Sequence[Record] = (),
    dynamics: HeldDynamics | None = None,
) -> Chosen:
    """Return the default chain for ``record``, the training samples.

    The hysteresis is the first of ``HYSTERESES``, or ``FROM_SEVERAL``, unless another
    one has a clearly smaller error (``CLEARLY``) after a short fit to ``record`` and
    those ``beside`` it together; ``DENSITY`` must be clearly better than all of them.
    Those within a factor of ``CLOSE`` of the best are fitted longer before they are
    compared. The fits use the first samples of a long record (``leading``), those to a
    single one also a lower sampling rate if it resolves the resonances and the input.
    With ``dynamics``, which are held, the chain has no other dynamics; the rate is not
    lowered if they exist at one rate only. Raises ValueError if no fit succeeds.
    """
    records = [record, *beside]
    name, begun = hysteresis_for(records, progress, dynamics)
    return Chosen(_chain_of(name, records, dynamics), begun)


def _chain_of(
    hysteresis: str, records: Sequence[Record], dynamics: HeldDynamics | None
) -> str:
    first, *beside = records
    behind = dynamics_parts(first, beside) if dynamics is None else ""
    return "+".join(part for part in (hysteresis, CREEP, behind) if part)


def hysteresis_for(
    records: Sequence[Record],
    progress: Progress | None = None,
    dynamics: HeldDynamics | None = None,
) -> Chosen:
    """Return the name of the hysteresis that fits ``records`` best.

    Bounds, and the dynamics if they are not held, are derived from the first record.
    Raises the ValueError of the first fit if all fits fail.
    """
    if records[0].samples < LEAST:
        return Chosen(HYSTERESES[0], None)
    progress = progress or Silent()
    progress.stage("choosing the hysteresis")
    records = [
        each.until(leading(each.input, slice(0, each.samples)).stop) for each in records
    ]
    if others := records[1:]:
        return _for_several(records[0], others, progress, dynamics)
    record, failed = records[0], []
    if dynamics is None or dynamics.any_rate:
        record = _slowed(record, _slowing(record))

    def error(name: str) -> float:
        """Return the error of a model, infinite if its fit fails."""
        try:
            return _error(name, record, dynamics)
        except ValueError as why:
            failed.append(why)
            return np.inf

    best = _best(HYSTERESES, error)
    _require_any(failed, HYSTERESES)
    return Chosen(best, None)


def _require_any(failed: Sequence[ValueError], names: Sequence[str]) -> None:
    """Raise the first error if the fit of every model of ``names`` has failed."""
    if len(failed) == len(names):
        raise failed[0]


def _best(names: Sequence[str], error: Callable[[str], float]) -> str:
    """Return the first of ``names``, or one with a clearly smaller ``error``."""
    chosen, *others = names
    least = CLEARLY * error(chosen)
    for name in others:
        found = error(name)
        if found < least:
            least, chosen = found, name
    return chosen


def _for_several(
    first: Record,
    beside: Sequence[Record],
    progress: Progress,
    dynamics: HeldDynamics | None,
) -> Chosen:
    records = [first, *beside]
    whole = slice(0, max(record.samples for record in records))
    chains = {name: _chain_of(name, records, dynamics) for name in EVERY}
    shown = rough = None
    if dynamics is None:
        # Plays that do not fit leave the dynamics at first sight.
        with contextlib.suppress(ValueError):
            plays = seen_again(chains[PLAYS], records, whole, progress, looks=LOOKS)
            shown, rough = plays.shown, plays.fit

    failed: list[ValueError] = []

    def fit(shape: Structure, begun: Optimum | None, passes: int) -> Optimum | None:
        if shown is not None:
            shape = shape._replace(whitening=())  # the dynamics are known already
        try:
            return output_error(
                shape,
                records,
                whole,
                steps=STEPS,
                progress=progress,
                passes=passes,
                begun=begun,
            )
        except ValueError as why:
            failed.append(why)
            return None

    fits = {}
    for name, chain in chains.items():
        shape = structure(chain, first, dynamics, beside=beside, shown=shown)
        fits[name] = fit(shape, rough, PASSES)
    _require_any(failed, EVERY)

    def error(name: str) -> float:
        """Return the rms error of a fit, infinite if it failed.

        It includes the deviations from the prior, so that a model does not win by
        parameters that the records do not determine. Weights that they determine make
        it larger, as in generalised cross-validation (Craven and Wahba, Numerische
        Mathematik 31, 1979, 377-403).
        """
        found = fits[name]
        if found is None:
            return np.inf
        rms = float(np.sqrt(found.losses[0]))
        if found.weights is None:
            return rms
        _, independent = found.problem.spread(as_array(found.units[0]))
        left = 1.0 - found.weights.freedom / independent
        return rms / left if left > 0.0 else np.inf

    begun, limit = {}, CLOSE * min(map(error, EVERY))
    if shown is not None:
        close = [(name, found) for name, found in fits.items() if error(name) < limit]
        begun = {name: Begun(found, shown) for name, found in close if found}
    for name, last in [*begun.items()] if len(begun) > 1 else ():
        seen = seen_behind(last, chains[name], records)
        found = fit(seen.structure, seen.fit, LATER_PASSES)
        # The dynamics that show behind a fit may be worse than those it began with.
        if found is not None and found.losses[0] < last.fit.losses[0]:
            fits[name], begun[name] = found, Begun(found, seen.shown)
    best = _best((_best(FROM_SEVERAL, error), DENSITY), error)
    return Chosen(best, begun.get(best))


def _slowing(record: Record) -> int:
    """Return the number of samples of ``record`` per sample of a trial."""
    every = record.samples // SAMPLES
    modes = dynamics_of(record).modes
    if modes:
        fastest = max(mode.frequency for mode in modes)
        every = min(every, int(1.0 / (RESOLVED * fastest * record.dt)))
    whole = _variation(record)
    while every > max(1, record.samples // MOST):
        if _variation(_slowed(record, every)) > VARIATION * whole:
            break
        every //= 2
    return max(1, every)


def _variation(record: Record) -> float:
    """Return the total variation of the input of ``record``."""
    return float(np.sum(np.abs(np.diff(record.input))))


def _slowed(record: Record, every: int) -> Record:
    """Return ``record`` at a rate lower by the factor ``every``.

    A model delays the output by one sample. At the lower rate this must remain one
    sample of the record: the input is taken ``every`` - 1 samples later.
    """
    import scipy.signal  # takes long to import

    if every < 2:
        return record
    later = np.append(record.input[every - 1 :], [record.input[-1]] * (every - 1))
    input, output = (
        scipy.signal.decimate(signal, every, ftype="fir")
        for signal in (later, record.output)
    )
    return Record(input, output, every * record.dt, source=record.source)


def _error(name: str, record: Record, dynamics: HeldDynamics | None) -> float:
    """Return the error of the model ``name`` after a short fit to ``record``.

    It is the standard deviation of the free-run error. It is infinite if the fitted
    hysteresis has no inverse over the range of the input, because controllers need the
    inverse. Raises ValueError if the fit fails.
    """
    chain = _chain_of(name, [record], dynamics)
    every = slice(0, record.samples)
    system = output_error(
        structure(chain, record, dynamics), [record], every, steps=STEPS
    ).system
    try:
        hystereses(system)[0].inverse(record.input.min(), record.input.max())
    except ValueError:
        return np.inf
    run = np.asarray(from_rest(system, as_array(record.input)))
    return float(np.std(run - record.output))
