"""Search over structures: notches are added where a mode limits the tuned loop."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..core.paths import get, replace
from ..core.progress import Progress
from ..core.recipe import Resonance
from ..dynamics.plant_modes import PlantMode, plant_modes
from ..study import Case
from ..study.with_notches import NOTCH, OFF, moved, place_of, with_notches
from .outcome import Outcome
from .structure_choice import (
    LIMITING,
    Structure,
    StructureSearch,
    choose,
    criterion_text,
    explain,
)
from .structure_figures import Modes, in_loop, row_of, untuned

WIDTHS = 0.2, 0.6
"""Damping ratios of the poles of a notch from which a search starts."""

DEEPEST = 0.05
"""Gain at the centre of the deepest notch from which a search starts."""

Tune = Callable[[Case, np.ndarray | None, Progress], Outcome]
"""Function ``tune(case, also, progress)`` that tunes one structure.

``also`` are further points [points, n] of the unit box that may become starts."""


class _Tuned(NamedTuple):
    """A tuned structure: the modes at its notches, its outcome and its row."""

    at: Modes
    outcome: Outcome
    row: Structure


def search_structures(case: Case, tune: Tune, progress: Progress) -> Outcome:
    """Tune each structure of the study and return the Outcome of the chosen one.

    The first notch is placed at the mode around which |S| of the loop tuned without
    notches is largest, each further one at the mode around which |S| of the loop tuned
    so far is largest. A mode that contributes less than ``LIMITING`` to |L| does not
    limit the loop and gets no notch. If a further notch is needless
    (``Structure.needless``), the controller is tuned with a notch at the next mode
    instead, too; if the chosen structure has one, also without that notch. ``Ctrl-C``
    ends the search with the structures so far.
    Raises ValueError if no structure could be tuned, and as ``with_notches``.
    """
    table = case.study.structures
    assert table is not None
    place_of(case)
    modes, notes = _shown_modes(case)
    found: list[_Tuned] = []
    rows: list[Structure] = []
    tried: list[set[PlantMode]] = []

    def run(at: Modes, previous: _Tuned | None) -> bool:
        """Tune the structure with notches ``at`` these modes; return whether to go on.

        The search starts from the gains of the structure ``previous`` too.
        """
        tried.append(set(at))
        shown = " and ".join(f"{mode.frequency:.4g}" for mode in at)
        progress.stage(f"{len(at)} notches" + (f" at {shown} Hz" if at else ""))
        variant = with_notches(case, [_resonance(mode) for mode in at])
        also = _starts(case, variant, at, previous)
        try:
            outcome = tune(variant, also, progress)
        except ValueError as error:
            rows.append(untuned(len(at), at, str(error)))
            return True
        rows.append(row_of(case, at, modes, outcome))
        found.append(_Tuned(at, outcome, rows[-1]))
        return outcome.result.status != "interrupted"

    going = True
    for count in table.notches:
        previous = found[-1] if found else None
        at = previous.at if previous else ()
        others = _limiting(modes, previous)
        at = (*at, *others[: count - len(at)])
        if len(at) < count:
            reason = (
                f"not tuned: of {len(modes)} modes of the plant, no other contributes "
                f"{LIMITING:g} to the loop gain |L|"
            )
            rows.append(untuned(count, at, reason))
            continue
        going = going and run(at, previous)
        instead = _replaced(found, at, others)
        if going and instead is not None and set(instead) not in tried:
            going = run(instead, previous)
        if not going:
            break
    while going and (best := _best(found, table.worth)) is not None:
        without = [
            tuple(other for other in best.at if other != mode)
            for mode in best.at
            if mode.frequency in best.row.needless
        ]
        fewer = [
            at for at in without if len(at) in table.notches and set(at) not in tried
        ]
        if not fewer or not run(fewer[0], best):
            break
    best = _best(found, table.worth)
    if best is None:
        reasons = dict.fromkeys(row.reason for row in rows)
        raise ValueError("; ".join(reasons))
    explain(rows, rows.index(best.row))
    result, every = best.outcome.result, [one.outcome.result for one in found]
    result.structures = StructureSearch(
        criterion=criterion_text(table.worth), structures=rows
    )
    result.warnings = [*notes, *result.warnings]
    if len(found) > 1:
        result.warnings.append(
            f"structures: the hold-out chose among {len(found)} structures, so its "
            "error is that of the best of these and slightly too small"
        )
    result.evaluations = sum(one.evaluations for one in every)
    result.compile_s = sum(one.compile_s for one in every)
    result.wall_s = sum(one.wall_s for one in every)
    if any(one.status == "interrupted" for one in every):
        result.status = "interrupted"
    return best.outcome


def _best(found: Sequence[_Tuned], worth: float) -> _Tuned | None:
    chosen = choose([one.row for one in found], worth)
    return None if chosen is None else found[chosen]


def _shown_modes(case: Case) -> tuple[list[PlantMode], list[str]]:
    """Return the modes of the plant, and a note on those below its error bound.

    A mode of a fitted model whose share of the response is below the error bound may be
    a fit to noise. It is left out.
    """
    study = case.study
    reference = case.margin_reference
    assert isinstance(reference, float)  # structures are for one axis
    modes = plant_modes(case.loop.plant, reference, study.dt)
    bound = case.plant_about.error_bound
    if bound is None:
        return modes, []
    shown = [mode for mode in modes if mode.share > float(bound.at(mode.frequency))]
    dropped = [f"{mode.frequency:.4g}" for mode in modes if mode not in shown]
    if not dropped:
        return modes, []
    return shown, [
        f"structures: no notch is tried at {', '.join(dropped)} Hz, because the error "
        "bound of the model is larger than its mode there; a record with a chirp up to "
        "half the sampling rate lowers the bound"
    ]


def _replaced(
    found: Sequence[_Tuned], at: Modes, others: Sequence[PlantMode]
) -> Modes | None:
    """Return ``at`` with the next of ``others`` in place of needless ones of these.

    None if the structure ``at`` could not be tuned, needs its further notches, or
    ``others`` has no more modes.
    """
    if not found or found[-1].at != at:
        return None
    needless = [mode for mode in at if mode.frequency in found[-1].row.needless]
    free = [mode for mode in others if mode not in at]
    swaps = dict(zip((m for m in needless if m in others), free, strict=False))
    return tuple(swaps.get(mode, mode) for mode in at) if swaps else None


def _limiting(modes: Sequence[PlantMode], tuned: _Tuned | None) -> list[PlantMode]:
    """Return the modes without a notch that limit the ``tuned`` loop, worst first.

    The worst is the one around which |S| is largest. Without a linearised loop all
    modes without a notch are returned, sorted by gain over frequency: their order under
    integral control.
    """
    seen = in_loop(modes, tuned.outcome) if tuned else None
    had = tuned.at if tuned else ()
    if seen is None:
        free = [mode for mode in modes if mode not in had]
        return sorted(free, key=lambda mode: -mode.gain / mode.angle)
    free = [
        (sensitivity, mode)
        for (part, sensitivity), mode in zip(seen, modes, strict=True)
        if mode not in had and part >= LIMITING
    ]
    return [mode for _, mode in sorted(free, reverse=True)]


def _starts(
    case: Case, variant: Case, at: Modes, previous: _Tuned | None
) -> np.ndarray | None:
    """Return points of the box of ``variant`` from which its search may start.

    They are the gains of the study with all notches switched on; those of ``previous``
    with the further notches switched on; and those of ``previous`` with all notches set
    to their modes again. The loss does not depend on the frequency of a notch that is
    switched off.
    """
    if not at:
        return None
    place = place_of(case)
    paths = variant.space.paths
    own = {path: float(get(variant.loop, path)) for path in paths}

    def notch(number: int, mode: PlantMode, width: float) -> dict[str, float]:
        where = f"{place}.filter.{NOTCH.format(number)}"
        depth = min(max(mode.damping / width, DEEPEST), OFF)
        return {
            f"{where}.frequency": mode.frequency,
            f"{where}.damping": width,
            f"{where}.depth": depth,
        }

    def switched_on(values: Mapping[str, float], had: Modes) -> list[dict[str, float]]:
        found = []
        for width in WIDTHS:
            further = [notch(i, m, width) for i, m in enumerate(at, 1) if m not in had]
            found.append({k: v for part in (values, *further) for k, v in part.items()})
        return found

    points = switched_on(own, ())
    if previous is not None:
        tuned = own | _carried(previous, at, place)
        points += switched_on(tuned, previous.at) + switched_on(tuned, ())
    # Before the first notch the last two are the same.
    return np.unique([_unit(variant, values) for values in points], axis=0)


def _carried(previous: _Tuned, at: Modes, place: str) -> dict[str, float]:
    """Return the gains of ``previous`` by their path in the structure ``at``."""
    gains = previous.outcome.result.gains
    if not previous.at:
        return {moved(path, place): value for path, value in gains.items()}
    found = {}
    for path, value in gains.items():
        head, dot, tail = path.removeprefix(f"{place}.filter.").partition(".")
        if not path.startswith(f"{place}.filter."):
            found[path] = value
            continue
        names = {NOTCH.format(i): mode for i, mode in enumerate(previous.at, 1)}
        if names[head] in at:
            number = 1 + at.index(names[head])
            found[f"{place}.filter.{NOTCH.format(number)}{dot}{tail}"] = value
    return found


def _unit(case: Case, values: Mapping[str, float]) -> np.ndarray:
    """Return ``values`` by path, moved into their bounds, as a point of the box."""
    ranges = case.space.ranges()
    inside = {
        path: min(max(values[path], bounds.lower), bounds.upper)
        for path, bounds in ranges.items()
    }
    return np.asarray(case.space.start(replace(case.loop, inside)))


def _resonance(mode: PlantMode) -> Resonance:
    return Resonance(mode.frequency, mode.damping)
