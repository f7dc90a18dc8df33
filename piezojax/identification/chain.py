"""Chains of parts in series with an offset, as structures to fit."""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from ..core.paths import replace
from ..core.recipe import Extent, Recipe, scaled_range
from ..core.registry import parts as known_parts
from ..core.space import Range, Space, space_of
from ..core.system import Affine, Series, series
from ..hysteresis.model import Hysteresis
from .estimators.resonances import LinearDynamics, linear_dynamics
from .estimators.slew_rate import few_steps, has_steps
from .estimators.start_search import BEYOND
from .estimators.structure import Structure, distinct
from .held_dynamics import HeldDynamics
from .records.record import Record

LINEAR = ("dynamics", "lag", "delay")
"""Places of linear dynamics, whose parameters the record must excite."""

SLOW = ("creep",)
"""Places of slow parts, whose parameters a short record does not determine."""

DEFAULT = "auto"
"""Model that is fitted by default (``automatic``)."""

DRIVE = "drive"
"""Place of the part that acts first."""

SLEW = f"{DRIVE}.rate"
"""Path of the slew rate of the amplifier."""

OFFSET = "calibration.offset"
"""Parameter that stands for the zero of the sensor."""

FRACTION = 0.2
"""Delay, in samples, above which a model with a mode has a part for it."""


def chain(name: str) -> list[str]:
    """Return the parts of a model such as ``"coleman_hodgdon+logarithmic_creep+lag"``.

    A hysteresis by itself is followed by a lag, unless it contains dynamics. Raises
    ValueError for an unknown part or for two parts in one place.
    """
    known = known_parts()
    parts = [part.strip() for part in name.split("+")]
    for part in parts:
        if part not in known:
            raise ValueError(
                f"a model has no part {part!r}; there are {', '.join(known)}, "
                "joined by '+'; whole models stand by themselves (--model help)"
            )
    places = [known[part].part.place for part in parts]
    for place in places:
        if places.count(place) > 1:
            raise ValueError(f"model {name!r} has two parts for its {place}")
    lagged = places == ["hysteresis"] and not is_dynamic(parts[0])
    return [*parts, "lag"] if lagged else parts


def is_own(path: str) -> bool:
    """Return whether each record has its own value of the parameter at ``path``.

    These are the state of a hysteresis before the record and the zero of the sensor.
    """
    return path == OFFSET or path.endswith("rest_input")


def is_dynamic(part: str) -> bool:
    """Return whether a part is a hysteresis that contains dynamics."""
    kind = known_parts()[part]
    return issubclass(kind, Hysteresis) and kind.dynamic


def training_record(records: Sequence[Record], train: slice) -> Record:
    """Return the first record of ``by_evidence``, up to the end of ``train``."""
    return by_evidence(records, train)[0]


def by_evidence(records: Sequence[Record], train: slice) -> list[Record]:
    """Return the samples of each record up to the end of ``train``, sorted.

    Records with steps come first, because they show resonances and the slew rate best;
    then those that show the most resonances, then those with the largest range. Models,
    bounds and starts must not depend on the validation part.
    """
    parts = [record.until(train.stop) for record in records]
    if len(parts) == 1:
        return parts

    def shows(record: Record) -> tuple[bool, int, float]:
        if not record.single:
            return False, 0, record.span
        modes = dynamics_of(record).modes
        return has_steps(record.input), len(modes), record.span

    return sorted(parts, key=shows, reverse=True)


def dynamics_of(record: Record) -> LinearDynamics:
    """Return the linear dynamics that a record of one input and one output shows."""
    found = linear_dynamics(record.input, record.output, record.dt)
    return found._replace(input_unit=record.input_unit)


def shown_dynamics(records: Sequence[Record], train: slice) -> LinearDynamics:
    """Return the dynamics that the training part shows, none for several channels."""
    if not all(record.single for record in records):
        return LinearDynamics()
    return dynamics_of(training_record(records, train))


def dynamics_parts(record: Record, beside: Sequence[Record] = ()) -> str:
    """Return the chain of linear dynamics that ``record`` shows, a lag if none.

    A slew rate is among them if the record shows one. Delay and slew rate are if this
    record or those ``beside`` it have steps that are too few to tell them apart. With
    several records the chain has room for the modes, lag, delay and, with steps, slew
    rate that show only behind a fitted hysteresis (``second_sight``).
    """
    shown = dynamics_of(record)
    if not shown.modes:
        return "lag"
    several = bool(beside)
    late = shown.delay is not None and shown.delay > FRACTION * record.dt
    unclear = unclear_step(record, beside) > 0.0
    alone = len(shown.modes) == 1 and not shown.lags and not several
    found = ["mode" if alone else "modes"]
    found += ["delay"] * (late or unclear or several)
    slews = shown.slew is not None or unclear or (several and has_steps(record.input))
    return "+".join(found + ["slew"] * slews)


def unclear_step(record: Record, beside: Sequence[Record]) -> float:
    """Return the largest step (V) whose ramp may be in the delay of ``record``, or 0.

    A record with many steps, which comes first (``by_evidence``), shows the slew rate.
    """
    if has_steps(record.input) or dynamics_of(record).slew is not None:
        return 0.0
    return max(few_steps(each.input) for each in (record, *beside))


def extent_of(
    record: Record,
    beside: Sequence[Record] = (),
    reach: float = 1.0,
    shown: LinearDynamics | None = None,
) -> Extent:
    """Return the ranges of a record with one input and one output, and its dynamics.

    The range of the input is that of all records, with those ``beside`` it. ``reach``
    is that of Extent. ``shown`` are the dynamics if they are known better than from the
    record.
    """
    x, y = record.input, record.output
    shown, span = shown or dynamics_of(record), record.span
    slope = span / float(np.ptp(x)) * float(np.sign(np.cov(x, y)[0, 1]) or 1.0)
    if shown.modes and shown.slope:
        # Beside a resonance the range of the output says little about the slope.
        slope, span = shown.slope, abs(shown.slope) * float(np.ptp(x))
    return Extent(
        low=min(float(each.input.min()) for each in (record, *beside)),
        high=max(float(each.input.max()) for each in (record, *beside)),
        first=(float(x[0]), float(y[0])),
        slope=slope,
        centre=float(np.mean(y) - slope * np.mean(x)),
        span=span,
        dt=record.dt,
        duration=record.dt * record.samples,
        modes=shown.modes,
        lags=shown.lags,
        delay=shown.delay,
        slew=shown.slew,
        jump=unclear_step(record, beside),
        reach=reach,
        before=1.0 + 2.0 * BEYOND if beside else 1.0,
    )


def slow_chain(name: str, source: str) -> list[str]:
    """Return the parts of a model whose dynamics come from ``source``.

    Raises ValueError as for ``chain``, and for a part with dynamics.
    """
    known = known_parts()
    parts = [part.strip() for part in name.split("+")]
    chain(name)  # its checks
    for part in parts:
        if known[part].part.place in LINEAR or is_dynamic(part):
            raise ValueError(
                f"the dynamics come from {source}: leave {part} out of the model, as "
                "in coleman_hodgdon+exponential_creep"
            )
    return parts


def structure(
    name: str,
    record: Record,
    dynamics: HeldDynamics | None = None,
    *,
    beside: Sequence[Record] = (),
    reach: float = 1.0,
    shown: LinearDynamics | None = None,
) -> Structure:
    """Return the chain ``name`` with starts and bounds derived from ``record``.

    They hold for the input of the records ``beside`` it too. Each of several records
    has another past: the virgin state of a hysteresis is then that at zero input and
    output, as of a stage without power. An offset of the output is always added. With
    ``dynamics``, which are held, the chain has no other dynamics. ``reach`` and
    ``shown`` are those of ``extent_of``. Raises ValueError as for ``chain`` and
    ``slow_chain``.
    """
    shown = shown or dynamics_of(record)
    extent = extent_of(record, beside, reach, shown)
    known = known_parts()
    names = slow_chain(name, dynamics.source) if dynamics else chain(name)
    kinds = [known[part] for part in names]
    kinds.sort(key=lambda kind: kind.part.place != DRIVE)
    falls = extent.slope < 0.0 and any(kind.rising for kind in kinds)
    described = extent.mirrored() if falls else extent
    parts = {kind.part.place: kind.recipe(described) for kind in kinds}
    if dynamics is not None:
        held = dynamics.at(record.dt)
        parts |= {place: Recipe(system, {}) for place, system in held.items()}
    reach = 2.0 * extent.span
    # A hysteresis converts volts to the unit of the output; without one this gain does.
    slope = extent.slope
    if "hysteresis" in parts:
        slope = -1.0 if falls else 1.0
    scaled = "hysteresis" in parts or any(part.gain for part in parts.values())
    parts["calibration"] = Recipe(
        Affine(slope, extent.centre),
        {
            **({} if scaled else {"gain": scaled_range(slope, 0.0, 3.0)}),
            "offset": Range(extent.centre - reach, extent.centre + reach),
        },
    )
    system = series(**{place: part.system for place, part in parts.items()})
    own = [f"{place}.{path}" for place, part in parts.items() for path in part.own]
    if beside:
        system = replace(system, dict.fromkeys(own, 0.0))
    gains = [f"{place}.{part.gain}" for place, part in parts.items() if part.gain]
    bounds = {
        f"{place}.{path}": bound
        for place, part in parts.items()
        for path, bound in part.bounds.items()
        # The record determines only the product of gains in series.
        if f"{place}.{path}" not in gains[:-1]
    }
    space = space_of(bounds)

    def within(places: Sequence[str]) -> tuple[str, ...]:
        return tuple(path for path in bounds if path.split(".")[0] in places)

    return Structure(
        system,
        space,
        _starts(system, space, parts),
        own=(*own, OFFSET),
        dynamics=within(LINEAR),
        slow=within(SLOW),
        vague={
            f"{place}.{path}": distance / (bound.upper - bound.lower)
            for place, part in parts.items()
            for path, distance in part.vague.items()
            for bound in (part.bounds[path],)
        },
        whitening=shown.whitening if shown.modes and dynamics is None else (),
        linear=next(
            (
                part.linear._replace(path=f"{place}.{part.linear.path}")
                for place, part in parts.items()
                if part.linear
            ),
            None,
        ),
    )


def _starts(system: Series, space: Space, parts: Mapping[str, Recipe]) -> np.ndarray:
    """Return the combinations of the parts' alternatives, as points of the unit box."""
    choices = [
        [
            {f"{place}.{path}": value for path, value in one.items()}
            for one in part.alternatives
        ]
        for place, part in parts.items()
    ]
    found = []
    for combination in product(*choices):
        changes = {path: value for one in combination for path, value in one.items()}
        changed = replace(system, changes)
        found.append(space.nearest(changed))
    return distinct(np.stack(found))
