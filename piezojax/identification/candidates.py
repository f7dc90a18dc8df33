"""Which models a record can support: what ``--model all`` tries, and what it does not.

Every hysteresis is first fitted with the richest creep and dynamics that the records
can show; only the best few then with other creeps or none, and the best of those with
simpler dynamics. All combinations would take many times as long and tell no more.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from ..core.recipe import Extent
from ..core.registry import parts as known_parts
from .chain import extent_of, is_dynamic
from .estimators.estimate import Options
from .estimators.model_preisach import PLAIN, RATE_DEPENDENT, TOO_FEW, cells_told_apart
from .methods import METHODS
from .records.checks import lines
from .records.record import Record

CREEP_SECONDS = 1.0
"""Shortest training part in which creep is looked for.

Creep goes with the logarithm of time from about 0.1 s on (Jung and Gweon 2000, Rev.
Sci. Instrum. 71(4)): a second holds a decade of it.
"""

CREEP = "exponential_creep"
"""The creep tried first: the most general one."""

DYNAMICS = ("arma", "lag")
"""Dynamics of a chain, richest first; the last one is tried on any record."""


LINEAR = "state_space"
"""The whole model without hysteresis."""


class Candidate(NamedTuple):
    """A model to try, and the method that fits it (None: the first that can)."""

    model: str
    method: str | None = None


class Untried(NamedTuple):
    """A model that is not tried, and why."""

    model: str
    reason: str


class Companions(NamedTuple):
    """Creeps ("" for none) and dynamics behind a hysteresis, richest first."""

    creeps: tuple[str, ...]
    dynamics: tuple[str, ...]


def at(place: str) -> list[str]:
    """Return the parts that have ``place`` in a chain."""
    return [name for name, kind in known_parts().items() if kind.part.place == place]


def companions(
    records: Sequence[Record], train: slice
) -> tuple[Companions, list[Untried]]:
    """Return the creeps and dynamics that records with one input and output support."""
    untried = []
    seconds = max(_seen(record, train) for record in records)
    creeps = [CREEP, *(name for name in at("creep") if name != CREEP), ""]
    if seconds < CREEP_SECONDS:
        untried += [
            Untried(
                name,
                f"the training part lasts {seconds:.3g} s; creep is looked for from "
                f"{CREEP_SECONDS:g} s on",
            )
            for name in creeps[:-1]
        ]
        creeps = [""]
    found, extent = excitation(records, train), extent_of(records[0])
    dynamics = []
    for name in DYNAMICS:
        needed = _unknowns(name, extent)
        if 2 * found >= needed or name == DYNAMICS[-1]:
            dynamics.append(name)
        else:
            untried.append(Untried(name, _too_few(found, needed)))
    return Companions(tuple(creeps), tuple(dynamics)), untried


def _unknowns(part: str, extent: Extent) -> int:
    """Return how many parameters of a part are fitted."""
    return len(known_parts()[part].recipe(extent).bounds)


def excitation(records: Sequence[Record], train: slice) -> int:
    """Return the most frequencies that an input holds in the training part."""
    return max(lines(input) for r in records for input in r.inputs[train].T)


def _too_few(found: int, needed: int) -> str:
    return (
        f"{found} {'frequency' if found == 1 else 'frequencies'} in the training part "
        f"can tell {2 * found} parameters of linear dynamics, and it has {needed}"
    )


def _seen(record: Record, train: slice) -> float:
    return (min(train.stop, record.samples) - train.start) * record.dt


def chained(hysteresis: str, creep: str, dynamics: str) -> str:
    """Return the chain of the parts, of which some may be empty."""
    alone = hysteresis != "" and is_dynamic(hysteresis)
    parts = [hysteresis, creep, "" if alone else dynamics]
    return "+".join(part for part in parts if part)


def first_round(
    records: Sequence[Record],
    train: slice,
    options: Options,
    hysteresis: Sequence[str] | None = None,
) -> tuple[list[Candidate], list[Untried]]:
    """Return what to fit first: a linear model, each hysteresis, the whole models.

    ``hysteresis`` names the parts and whole models to try (all if left out), beside
    linear ones. Raises ValueError for a name that is no hysteresis, or if none of those
    named can be tried.
    """
    parts = at("hysteresis")
    known = [*parts, *(name for name in whole_names() if name != LINEAR)]
    names = known if hysteresis is None else list(hysteresis)
    for name in names:
        if name not in known:
            raise ValueError(f"{name!r} is no hysteresis; there are {', '.join(known)}")
    parts = [name for name in names if name in parts]
    whole, untried = whole_models(records, train, options)
    whole = [one for one in whole if one.model in (LINEAR, *names)]
    untried = [one for one in untried if one.model in (LINEAR, *names)]
    if names and {one.model for one in untried} >= set(names):
        reasons = "; ".join(
            f"{one.model}: {one.reason}" for one in untried if one.model in names
        )
        raise ValueError(f"none of them can be tried: {reasons}")
    several = _several(records)
    if several:
        return whole, [*(Untried(name, several) for name in parts), *untried]
    found, missing = companions(records, train)
    creep, dynamics = found.creeps[0], found.dynamics[0]
    chains = [Candidate(chained(name, creep, dynamics)) for name in ("", *parts)]
    return [*chains, *whole], [*missing, *untried]


def later_rounds(
    records: Sequence[Record], train: slice
) -> list[Callable[[Sequence[str]], list[Candidate]]]:
    """Return what makes further rounds of the best chains so far.

    Each with the other creeps, or none; then each with the simpler dynamics.
    """
    if _several(records):
        return []
    found, _ = companions(records, train)

    def creeps(best: Sequence[str]) -> list[Candidate]:
        return _new(best, found.creeps[1:], found.dynamics[:1])

    def dynamics(best: Sequence[str]) -> list[Candidate]:
        return [
            candidate
            for model in best
            for candidate in _new([model], [_creep_of(model)], found.dynamics[1:])
        ]

    return [creeps, dynamics]


def _new(
    best: Sequence[str], creeps: Sequence[str], dynamics: Sequence[str]
) -> list[Candidate]:
    return [
        Candidate(model)
        for name in dict.fromkeys(model.split("+")[0] for model in best)
        for model in dict.fromkeys(
            chained(name, creep, behind) for behind in dynamics for creep in creeps
        )
        if model not in best
    ]


def _creep_of(model: str) -> str:
    return next((part for part in model.split("+") if part in at("creep")), "")


def _several(records: Sequence[Record]) -> str | None:
    """Return why no chain of parts can be fitted, or None."""
    for record in records:
        inputs, outputs = record.inputs.shape[1], record.outputs.shape[1]
        if (inputs, outputs) != (1, 1):
            return (
                f"the record has {inputs} input{'s' * (inputs > 1)} and {outputs} "
                f"output{'s' * (outputs > 1)}; a chain of parts has one of each"
            )
    return None


def whole_names() -> list[str]:
    """Return the models that are no chain of parts."""
    return list(dict.fromkeys(m for way in METHODS.values() for m in way.models))


def whole_models(
    records: Sequence[Record], train: slice, options: Options
) -> tuple[list[Candidate], list[Untried]]:
    """Return the models that are no chain of parts, those of METHODS, sorted out."""
    found, untried = [], []
    for model in whole_names():
        method = None
        if model == LINEAR and all(r.period for r in records):
            method = "frequency_response"
        against = _AGAINST.get(model, lambda *_: None)(records, train, options)
        if against is None:
            found.append(Candidate(model, method))
        else:
            untried.append(Untried(model, against))
    return found, untried


def _against_regression(
    records: Sequence[Record], train: slice, options: Options
) -> str | None:
    del options
    if against := _against_all_but_one(records):
        return against
    found = excitation(records, train)
    needed = _unknowns("arma", extent_of(records[0]))
    return _too_few(found, needed) if 2 * found < needed else None


def _against_state_space(
    records: Sequence[Record], train: slice, options: Options
) -> str | None:
    if all(record.period for record in records):
        return None
    if any(record.inputs.shape[1] > 1 for record in records):
        return (
            "several inputs at once need --period, or a record that drives each alone"
        )
    if len(records) > 1 and _several(records) is None:
        return "it takes each record for another input of the stage"
    found, needed = excitation(records, train), 2 * options.order
    return _too_few(found, needed) if 2 * found < needed else None


def _against_periods(
    records: Sequence[Record], train: slice, options: Options
) -> str | None:
    del train, options
    if records[0].period is None:
        return "it needs a periodic record (--period)"
    return _against_several_records(records)


def _against_preisach(
    model: str, records: Sequence[Record], train: slice, options: Options
) -> str | None:
    del options
    if against := _against_all_but_one(records):
        return against
    return None if cells_told_apart(records[0], train, model) else TOO_FEW[model]


def _against_all_but_one(records: Sequence[Record]) -> str | None:
    """Return what speaks against all but one record of one input and one output."""
    return _against_several_records(records) or _several(records)


def _against_several_records(records: Sequence[Record]) -> str | None:
    return f"{len(records)} records; it takes one" if len(records) > 1 else None


_AGAINST = {
    "hysteretic_arma": _against_regression,
    LINEAR: _against_state_space,
    "bouc_wen": lambda *of: _against_periods(*of) or _several(of[0]),
    "neural_state_space": _against_periods,
    PLAIN: partial(_against_preisach, PLAIN),
    RATE_DEPENDENT: partial(_against_preisach, RATE_DEPENDENT),
}
"""What speaks against a model; one that is not here is tried on any record."""
