"""A plant that is known already, fitted again to new records of the same stage.

The fit is the most likely one a posteriori: every parameter has a normal prior around
its known value. Where short records give no information, as on voltages beyond their
range, the known value stays.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..core.about import About
from ..core.paths import declared, get, parameters, replace
from ..core.registry import parts as known_parts
from ..core.space import Range, space_of
from ..core.system import Affine, Series, System
from ..dynamics import FractionalDelay
from .chain import LINEAR, by_evidence, dynamics_of, is_own
from .estimators.structure import Prior, Structure
from .records.record import Record

CHANGED = 0.3
"""Standard deviation of a parameter since it was fitted, as a share of its value."""

LATE, MORE = 1.0, 5
"""Standard deviation and largest increase of a delay since it was fitted, in
samples."""

FACTOR, REACH = 3.0, 4.0
"""Factor between a known value and its bounds; distance of the bounds from a value that
is smaller than its standard deviation, in these deviations."""

UNEXPLAINED, INDEPENDENT = 0.01, 25
"""Assumed rms error of a model, as a share of the range of the output, and assumed
number of independent samples of it. Both set the scale of the prior."""

CALIBRATION, DELAY = "calibration", "delay"
GAIN = f"{CALIBRATION}.gain"


@dataclass(frozen=True)
class KnownPlant:
    """A ``system`` and its origin ``about``, which names its fitted parameters.

    Its linear dynamics, the delay included, are not fitted again if they are ``held``.
    A plant without a calibration, as from a frequency response, gets one. Raises
    ValueError for a plant without fitted parameters, and for one that is no chain of
    named parts.
    """

    system: System
    about: About
    held: bool = False

    def __post_init__(self):
        if not self.about.standard_errors:
            raise ValueError(
                "the plant has no fitted parameters that could be fitted again: "
                "identify it from a record first"
            )
        system = self.system
        if not (isinstance(system, Series) and system.names):
            raise ValueError(
                f"the plant, a {type(system).__name__}, has no named parts, and "
                "only a chain of named parts can be fitted again: identify one, as "
                "coleman_hodgdon+lag"
            )
        if CALIBRATION not in system.names:
            parts, names = (*system.parts, Affine()), (*system.names, CALIBRATION)
            chain = Series(parts, names)
            object.__setattr__(self, "system", chain)

    @property
    def model(self) -> str:
        """Names of its parts, as in ``identify``."""
        names: dict[type, str] = {kind: name for name, kind in known_parts().items()}
        assert isinstance(self.system, Series)
        parts = self.system.parts
        return "+".join(names[type(part)] for part in parts if type(part) in names)

    def structure(self, records: Sequence[Record]) -> Structure:
        """Return the plant as a structure to fit to ``records``.

        The starts are the known values, as they are and with the modes moved to the
        resonances that the records show. Both are also tried with a longer delay,
        because a search does not leave a delay of 0. A gain and a delay are fitted
        besides its own parameters. If the dynamics are held, the errors of a record
        count relative to its range: the errors of a hysteresis grow with the motion,
        and would hide the effect of the gain on small motions.
        """
        whole = slice(0, max(record.samples for record in records))
        best, *_ = by_evidence(records, whole)
        system = _with_delay(self.system, best.dt)
        deviations = self._deviations(system, best.dt)
        ranges = {path: _range(system, path, s) for path, s in deviations.items()}
        space = space_of(ranges)
        known = space.nearest(system)
        spans = np.array([record.span for record in records])
        if not self.held:
            spans = np.full_like(spans, spans.max())
        sizes = [record.samples for record in records]
        span = float(np.average(spans**-2.0, weights=sizes) ** -0.5)
        explained = UNEXPLAINED * span
        widths = np.asarray(space.upper - space.lower)
        shares = np.array(list(deviations.values())) / widths
        prior = Prior(known, shares, explained / math.sqrt(INDEPENDENT))
        shown = dynamics_of(best)
        resonances = [mode.frequency for mode in shown.modes]
        moved = _at_resonances(system, ranges, resonances)
        later = [_later(one, ranges, best.dt) for one in (moved, system)]
        starts = [space.nearest(one) for one in (moved, system, *later)]
        return Structure(
            system,
            space,
            np.stack([*{tuple(start): start for start in starts}.values()]),
            own=tuple(filter(is_own, ranges)),
            dynamics=tuple(filter(_is_linear, ranges)),
            whitening=shown.whitening if shown.modes else (),
            prior=prior,
            weights=tuple(map(float, span / spans)),
        )

    def with_dynamics(self, fitted: System) -> "KnownPlant":
        """Return this plant with the linear dynamics of ``fitted``, a new fit, held."""
        own = parameters(self.system)
        others = {path: own[path] for path in own if not _is_linear(path)}
        return dataclasses.replace(self, system=replace(fitted, others), held=True)

    def widened(self, about: About) -> About:
        """Return the origin ``about`` of a new fit, with all that the inputs cover.

        A plant from a frequency response covers no known range.
        """
        if not self.about.input_ranges:
            return about
        pairs = zip(about.input_ranges, self.about.input_ranges, strict=True)
        ranges = [(min(a[0], b[0]), max(a[1], b[1])) for a, b in pairs]
        # The known slews are empty in a file of an earlier version.
        pairs = zip(about.input_slews, self.about.input_slews, strict=False)
        slews = [max(pair) for pair in pairs]
        return about.model_copy(update={"input_ranges": ranges, "input_slews": slews})

    def _deviations(self, system: System, dt: float) -> dict[str, float]:
        """Return the standard deviations of the parameters of ``system`` by path."""
        there = parameters(system)
        errors = {GAIN: 0.0, **self.about.standard_errors}
        found = {
            path: math.hypot(error, CHANGED * float(get(system, path)))
            for path, error in errors.items()
            if path in there
        }
        late = {path: LATE * dt for path in there if path.startswith(f"{DELAY}.")}
        every = found | late
        return {
            path: every[path] for path in every if not (self.held and _is_linear(path))
        }


def _is_linear(path: str) -> bool:
    return path.partition(".")[0] in LINEAR


def _with_delay(system: System, dt: float) -> System:
    """Return ``system`` with a delay that may be longer than the known one."""
    assert isinstance(system, Series)
    names, parts = list(system.names), list(system.parts)
    if DELAY not in names:
        place = len(parts) - isinstance(parts[-1], Affine)
        names.insert(place, DELAY)
        parts.insert(place, FractionalDelay(0.0, dt, MORE, order=3))
    place = names.index(DELAY)
    delay = parts[place]
    if isinstance(delay, FractionalDelay):
        longest = math.ceil(float(delay.delay) / dt) + MORE
        parts[place] = dataclasses.replace(delay, longest=max(delay.longest, longest))
    return Series(tuple(parts), tuple(names))


def _range(system: System, path: str, deviation: float) -> Range:
    """Return the bounds of a parameter; a known value keeps its sign."""
    value, limits = float(get(system, path)), declared(system, path)
    if abs(value) > deviation and not path.startswith(f"{DELAY}."):
        low, high = sorted((value / FACTOR, value * FACTOR))
    else:
        low, high = value - REACH * deviation, value + REACH * deviation
    if limits is not None:
        margin = 1e-3 * (high - low)
        low = max(low, limits.least, limits.above + margin)
        high = min(high, limits.most, limits.below - margin)
    return Range(low, high)


def _later(system: System, ranges: Mapping[str, Range], dt: float) -> System:
    """Return ``system`` with its fitted delay one standard deviation longer."""
    found = [path for path in ranges if path.startswith(f"{DELAY}.")]
    return replace(system, {p: float(get(system, p)) + LATE * dt for p in found})


def _at_resonances(
    system: System, ranges: Mapping[str, Range], shown: Sequence[float]
) -> System:
    """Return ``system`` with its modes at the nearest frequencies ``shown``, Hz."""
    moved = {}
    for path, bounds in ranges.items():
        limits = declared(system, path)
        near = [each for each in shown if bounds.lower < each < bounds.upper]
        if near and limits is not None and limits.unit == "Hz":
            known = float(get(system, path))
            moved[path] = min(near, key=lambda each: abs(each - known))
    return replace(system, moved)
