"""Candidate models for records: those that ``--model all`` tries or leaves out.

Every hysteresis is first fitted with the richest creep and dynamics that the records
support. Then the best few are fitted with other creeps or none, and the best of those
with simpler dynamics. Fitting all combinations would take many times as long.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ..core.recipe import Extent
from ..core.registry import parts as known_parts
from .chain import by_evidence, dynamics_parts, extent_of, is_dynamic
from .estimators.estimate import Options
from .estimators.model_preisach import (
    PLAIN,
    RATE_DEPENDENT,
    TOO_FEW,
    distinguishable_cells,
)
from .estimators.scheduled_fit import MODEL as SCHEDULED
from .estimators.scheduled_fit import SAME_LEVEL
from .methods import METHODS
from .records.checks import lines
from .records.record import Record

CREEP_SECONDS = 1.0
"""Shortest training part, in s, for which models with creep are tried.

Creep grows with the logarithm of time from about 0.1 s on (Jung and Gweon 2000, Rev.
Sci. Instrum. 71(4)): a second covers one decade.
"""

CREEP = "exponential_creep"
"""The creep tried first: the most general one."""

DYNAMICS = ("arma", "lag")
"""Dynamics of a chain for records that show no resonance, richest first; the last is
tried on all of these records."""


LINEAR = "state_space"
"""Name of the linear model, which is not a chain of parts."""


class Candidate(NamedTuple):
    """A model to try and its method; None stands for the default method."""

    model: str
    method: str | None = None


class UntriedModel(NamedTuple):
    """A model that is not tried, and the reason."""

    model: str
    reason: str


class SupportedParts(NamedTuple):
    """Creeps ("" for none) and dynamics that follow a hysteresis, richest first."""

    creeps: tuple[str, ...]
    dynamics: tuple[str, ...]


def parts_at(place: str) -> list[str]:
    """Return the names of the parts for ``place`` in a chain."""
    return [name for name, kind in known_parts().items() if kind.part.place == place]


def supported_parts(
    records: Sequence[Record], train: slice
) -> tuple[SupportedParts, list[UntriedModel]]:
    """Return the creeps and dynamics that single-channel ``records`` support."""
    untried = []
    seconds = max(_train_duration(record, train) for record in records)
    creeps = [CREEP, *(name for name in parts_at("creep") if name != CREEP), ""]
    if seconds < CREEP_SECONDS:
        untried += [
            UntriedModel(
                name,
                f"the training part lasts {seconds:.3g} s; models with creep need at "
                f"least {CREEP_SECONDS:g} s",
            )
            for name in creeps[:-1]
        ]
        creeps = [""]
    training, *beside = by_evidence(records, train)
    found, extent = excitation(records, train), extent_of(training, beside)
    if extent.modes:
        # The error of a free run does not tell whether the mode is needed: creep and
        # hysteresis dominate it.
        without = (
            f"the training part shows a resonance at {extent.modes[0].frequency:.4g} Hz"
        )
        untried += [UntriedModel(name, without) for name in DYNAMICS]
        shown = dynamics_parts(training, beside)
        return SupportedParts(tuple(creeps), (shown,)), untried
    dynamics = []
    for name in DYNAMICS:
        needed = _parameter_count(name, extent)
        if 2 * found >= needed or name == DYNAMICS[-1]:
            dynamics.append(name if extent.slew is None else f"{name}+slew")
        else:
            untried.append(UntriedModel(name, _too_few(found, needed)))
    return SupportedParts(tuple(creeps), tuple(dynamics)), untried


def _parameter_count(part: str, extent: Extent) -> int:
    """Return the number of fitted parameters of a part."""
    return len(known_parts()[part].recipe(extent).bounds)


def excitation(records: Sequence[Record], train: slice) -> int:
    """Return the largest number of frequencies of an input in the training part."""
    return max(lines(input) for r in records for input in r.inputs[train].T)


def _too_few(found: int, needed: int) -> str:
    return (
        f"{found} {'frequency' if found == 1 else 'frequencies'} in the training part "
        f"determine {2 * found} parameters of linear dynamics; the model has {needed}"
    )


def _train_duration(record: Record, train: slice) -> float:
    return (min(train.stop, record.samples) - train.start) * record.dt


def chain_name(hysteresis: str, creep: str, dynamics: str) -> str:
    """Return the name of the chain of the given parts; a part may be empty."""
    alone = hysteresis != "" and is_dynamic(hysteresis)
    parts = [hysteresis, creep, "" if alone else dynamics]
    return "+".join(part for part in parts if part)


def first_round(
    records: Sequence[Record],
    train: slice,
    options: Options,
    hysteresis: Sequence[str] | None = None,
) -> tuple[list[Candidate], list[UntriedModel]]:
    """Return the candidates of the first round, and the models that are not tried.

    The candidates are a linear chain, a chain with each hysteresis, and the whole
    models (those that are not chains of parts). ``hysteresis`` names the parts and
    whole models to try beside the linear ones; all of them if left out. Raises
    ValueError for a name that is not a hysteresis, or if none of the named ones can be
    tried.
    """
    parts = parts_at("hysteresis")
    known = list(dict.fromkeys([*parts, *whole_names()]))
    known.remove(LINEAR)
    names = known if hysteresis is None else list(hysteresis)
    for name in names:
        if name not in known:
            raise ValueError(
                f"{name!r} is not a hysteresis model; there are {', '.join(known)}"
            )
    # One record determines the weights of a Preisach model one by one, or not at all.
    parts = [
        name for name in names if name in parts and (name != PLAIN or len(records) > 1)
    ]
    whole, untried = whole_models(records, train, options)
    whole = [c for c in whole if c.model in (LINEAR, *names)]
    untried = [
        excluded
        for excluded in untried
        if excluded.model in {LINEAR, *names} - set(parts)
    ]
    if names and {excluded.model for excluded in untried} >= set(names):
        reasons = "; ".join(
            f"{excluded.model}: {excluded.reason}"
            for excluded in untried
            if excluded.model in names
        )
        raise ValueError(f"none of the named models can be tried: {reasons}")
    several = _not_single_channel(records)
    if several:
        return whole, [*(UntriedModel(name, several) for name in parts), *untried]
    found, missing = supported_parts(records, train)
    creep, dynamics = found.creeps[0], found.dynamics[0]
    chains = [Candidate(chain_name(name, creep, dynamics)) for name in ("", *parts)]
    return [*chains, *whole], [*missing, *untried]


def later_rounds(
    records: Sequence[Record], train: slice
) -> list[Callable[[Sequence[str]], list[Candidate]]]:
    """Return the later rounds, each a function of the best chains.

    The function returns the candidates of its round. The first of these rounds replaces
    the creep, the second takes simpler dynamics.
    """
    if _not_single_channel(records):
        return []
    found, _ = supported_parts(records, train)

    def creeps(best: Sequence[str]) -> list[Candidate]:
        return _untried_chains(best, found.creeps[1:], found.dynamics[:1])

    def dynamics(best: Sequence[str]) -> list[Candidate]:
        return [
            candidate
            for model in best
            for candidate in _untried_chains(
                [model], [_creep_of(model)], found.dynamics[1:]
            )
        ]

    return [creeps, dynamics]


def _untried_chains(
    best: Sequence[str], creeps: Sequence[str], dynamics: Sequence[str]
) -> list[Candidate]:
    return [
        Candidate(model)
        for name in dict.fromkeys(model.split("+")[0] for model in best)
        for model in dict.fromkeys(
            chain_name(name, creep, behind) for behind in dynamics for creep in creeps
        )
        if model not in best
    ]


def _creep_of(model: str) -> str:
    return next((part for part in model.split("+") if part in parts_at("creep")), "")


def single_channel(records: Sequence[Record]) -> bool:
    """Return whether every record has one input and one output."""
    return _not_single_channel(records) is None


def _not_single_channel(records: Sequence[Record]) -> str | None:
    """Return the reason why chains cannot be fitted, or None for single channels."""
    for record in records:
        inputs, outputs = record.inputs.shape[1], record.outputs.shape[1]
        if (inputs, outputs) != (1, 1):
            return (
                f"the record has {inputs} input{'s' * (inputs > 1)} and {outputs} "
                f"output{'s' * (outputs > 1)}; a chain of parts has one of each"
            )
    return None


def whole_names() -> list[str]:
    """Return the names of the models that are not chains of parts."""
    return list(
        dict.fromkeys(model for method in METHODS.values() for model in method.models)
    )


def whole_models(
    records: Sequence[Record], train: slice, options: Options
) -> tuple[list[Candidate], list[UntriedModel]]:
    """Return the whole models of METHODS as candidates or as untried."""
    found, untried = [], []
    for model in whole_names():
        method = None
        if model == LINEAR and all(r.period for r in records):
            method = "frequency_response"
        objection = _OBJECTIONS.get(model, lambda *_: None)(records, train, options)
        if objection is None:
            found.append(Candidate(model, method))
        else:
            untried.append(UntriedModel(model, objection))
    return found, untried


def _objection_to_regression(
    records: Sequence[Record], train: slice, options: Options
) -> str | None:
    del options
    if objection := _objection_to_single(records):
        return objection
    found = excitation(records, train)
    needed = _parameter_count("arma", extent_of(records[0]))
    return _too_few(found, needed) if 2 * found < needed else None


def _objection_to_state_space(
    records: Sequence[Record], train: slice, options: Options
) -> str | None:
    if all(record.period for record in records):
        return None
    if any(record.inputs.shape[1] > 1 for record in records):
        return (
            "several inputs at once need --period, or a record that drives each alone"
        )
    if len(records) > 1 and _not_single_channel(records) is None:
        return "it treats each record as another input of the stage"
    found, needed = excitation(records, train), 2 * options.order
    return _too_few(found, needed) if 2 * found < needed else None


def _objection_to_periods(
    records: Sequence[Record], train: slice, options: Options
) -> str | None:
    del train, options
    if records[0].period is None:
        return "it needs a periodic record (--period)"
    return _several_records(records)


def _objection_to_scheduled(
    records: Sequence[Record], train: slice, options: Options
) -> str | None:
    """Return the objection unless there are periods, several channels and levels."""
    del options
    if any(record.period is None for record in records):
        return "it needs periodic records (--period)"
    if _not_single_channel(records) is None:
        return "it is for several inputs or outputs"
    drives = [np.mean(record.inputs[train].std(axis=0)) for record in records]
    if max(drives) <= min(drives) * (1.0 + SAME_LEVEL):
        return "it needs records of two or more drive levels"
    return None


def _objection_to_preisach(
    model: str, records: Sequence[Record], train: slice, options: Options
) -> str | None:
    del options
    if objection := _objection_to_single(records):
        return objection
    return None if distinguishable_cells(records[0], train, model) else TOO_FEW[model]


def _objection_to_single(records: Sequence[Record]) -> str | None:
    """Return the objection unless there is one record with one input and output."""
    return _several_records(records) or _not_single_channel(records)


def _several_records(records: Sequence[Record]) -> str | None:
    return f"{len(records)} records; the model takes one" if len(records) > 1 else None


_OBJECTIONS = {
    "hysteretic_arma": _objection_to_regression,
    LINEAR: _objection_to_state_space,
    "bouc_wen": lambda *of: _objection_to_periods(*of) or _not_single_channel(of[0]),
    "neural_state_space": _objection_to_periods,
    SCHEDULED: _objection_to_scheduled,
    PLAIN: partial(_objection_to_preisach, PLAIN),
    RATE_DEPENDENT: partial(_objection_to_preisach, RATE_DEPENDENT),
}
"""Functions that return the reason not to try a model, or None. A model without such a
function is always tried."""
