"""Linear dynamics of a saved model, held while hysteresis and creep are fitted.

A frequency response shows modes, lag and delay; a slow record over the whole range
shows hysteresis and creep. If the dynamics from the response are held in the fit to the
record, both together give the whole plant.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..core.about import About
from ..core.conversion import factor
from ..core.error_bound import UNSEEN, ErrorBound, banded
from ..core.recipe import Fittable
from ..core.rollout import simulate
from ..core.system import Affine, Delay, Series, System, accepts, rest_output
from ..dynamics import FirstOrderLag, FractionalDelay, Mode, Modes, SecondOrderLag
from ..dynamics.linearise import sample_time
from ..hysteresis.model import hystereses
from .estimators.line_noise import MOST_LINES
from .records.record import Record

CONTINUOUS = (Mode, Modes, FirstOrderLag, SecondOrderLag, FractionalDelay)
"""Parts whose parameters are those of continuous time: they suit any sample time."""

DECADE = 10.0
"""Ratio of the ends of a band up to the highest excited frequency of a record. The
least error in this band is taken as that of the hysteresis at unexcited lines."""

LEAST_GAIN, MOST_GAIN = 1.0 / 3.0, 1.5
"""Bounds of the ratio of the gain for small motions to the slope of a record."""

LINEAR = 1e-6
"""Largest relative deviation from f(a u) = a f(u) that counts as linear."""


@dataclass(frozen=True)
class HeldDynamics:
    """Linear ``parts`` of unit static gain, by name, with the sample time ``dt`` (s).

    ``gain`` is the static gain of the whole model, None if it has a hysteresis.
    ``about`` is the origin of the model and ``source`` its name.
    """

    parts: Mapping[str, System]
    dt: float
    gain: float | None
    about: About
    source: str

    @property
    def any_rate(self) -> bool:
        """Whether all parts exist at any sample time."""
        kinds = (Affine, Delay, *CONTINUOUS)
        return all(isinstance(part, kinds) for part in self.parts.values())

    def at(self, dt: float) -> dict[str, System]:
        """Return the parts at the sample time ``dt`` (s) of a record.

        Raises ValueError for a part that exists only at another sample time.
        """
        if math.isclose(dt, self.dt, rel_tol=1e-9):
            return dict(self.parts)
        return {name: self._at(name, part, dt) for name, part in self.parts.items()}

    def _at(self, name: str, part: System, dt: float) -> System:
        if isinstance(part, Affine):
            return part
        delay = part.samples * self.dt if isinstance(part, Delay) else None
        if isinstance(part, FractionalDelay):
            delay = float(part.delay)
        if delay is not None:
            return FractionalDelay(delay, dt, max(1, math.ceil(delay / dt)), order=3)
        if isinstance(part, CONTINUOUS):
            return dataclasses.replace(part, dt=dt)
        raise ValueError(
            f"{name} of {self.source} is a {type(part).__name__}, which runs at "
            f"{1.0 / self.dt:.6g} Hz alone: resample the record (--resample "
            f"{1.0 / self.dt:.6g})"
        )

    def plant(self, fitted: System) -> System:
        """Return the chain ``fitted`` to a record, at the sample time of the dynamics.

        Its hysteresis and creep take that sample time.
        """
        if not isinstance(fitted, Series):
            return fitted
        parts = {
            name: self.parts.get(name, part)
            for name, part in zip(fitted.names, fitted.parts, strict=True)
        }
        changed = {
            name: dataclasses.replace(part, dt=self.dt)
            for name, part in parts.items()
            if name not in self.parts and hasattr(part, "dt")
        }
        return Series(tuple((parts | changed).values()), fitted.names)

    def standard_errors(self) -> dict[str, float]:
        """Return the standard errors of the parameters of the parts, by path."""
        return {
            path: error
            for path, error in self.about.standard_errors.items()
            if path.partition(".")[0] in self.parts
        }

    def gain_notes(self, record: Record) -> tuple[list[str], list[str]]:
        """Return alarms and notes on the gain of the model and the slope of a record.

        Both are empty for a model whose gain, or its unit, is not known.
        """
        units = [self.about.units.get(side) for side in ("input", "output")]
        own = [record.input_unit, record.output_unit]
        factors = [
            factor(unit, wanted) if unit else None
            for unit, wanted in zip(units, own, strict=True)
        ]
        if self.gain is None or factors[0] is None or factors[1] is None:
            return [], []
        gain = self.gain * factors[1] / factors[0]
        slope = float(np.polyfit(record.input, record.output, 1)[0])
        unit = f"{record.output_unit}/{record.input_unit}"
        text = (
            f"the gain of {self.source} is {gain:.4g} {unit}, for small motions, and "
            f"the slope of the record {slope:.4g} {unit}"
        )
        if slope == 0.0 or not LEAST_GAIN < gain / slope < MOST_GAIN:
            return [f"{text}: units, columns or stage differ"], []
        return [], [text]


def held_dynamics(system: System, about: About, source: str) -> HeldDynamics:
    """Return the linear dynamics of a saved ``system``.

    In a series they are the parts behind its last hysteresis or creep, without gains
    and offsets. A static gain other than 1 is divided out. Raises ValueError if there
    are none, if they are nonlinear, diverge or have several inputs or outputs, for a
    static gain of 0, and if the sample time is not known.
    """
    nonlinear = bool(hystereses(system))
    if isinstance(system, Series):
        names = system.names or tuple(map(str, range(len(system.parts))))
        parts = dict(zip(names, system.parts, strict=True))
        before = [name for name, part in parts.items() if _is_slow(part)]
        behind = names[names.index(before[-1]) + 1 :] if before else names
        parts = {
            name: parts[name] for name in behind if not isinstance(parts[name], Affine)
        }
    else:
        parts = {} if _is_slow(system) or nonlinear else {"dynamics": system}
    if not parts:
        raise ValueError(f"{source} has no linear dynamics behind its hysteresis")
    tail = Series(tuple(parts.values()))
    _check_linear(tail, source)
    unit = float(rest_output(tail, 1.0))
    if not (math.isfinite(unit) and unit != 0.0):
        raise ValueError(f"the dynamics of {source} have the static gain {unit:g}")
    if abs(unit - 1.0) > 1e-9:
        parts["unit_gain"] = Affine(1.0 / unit)
    rate = about.rate_Hz
    dt = sample_time(tail) if rate is None else 1.0 / rate
    gain = None
    if not nonlinear:
        gain = float(rest_output(system, 1.0)) - float(rest_output(system, 0.0))
    return HeldDynamics(parts, dt, gain, about, source)


def _is_slow(part: System) -> bool:
    """Return whether a part is a hysteresis or a creep, or contains one."""
    creep = isinstance(part, Fittable) and part.part.place == "creep"
    return creep or bool(hystereses(part))


def _check_linear(tail: System, source: str) -> None:
    if not accepts(tail, 0.0):
        raise ValueError(
            f"the dynamics of {source} have several inputs; a chain of parts has one"
        )
    drive = np.random.default_rng(0).standard_normal(200)
    one, many = (
        np.asarray(simulate(tail, scale * drive, tail.init(0.0))[1])
        for scale in (1.0, -3.0)
    )
    if one.shape != drive.shape or not np.all(np.isfinite(one)):
        raise ValueError(f"the dynamics of {source} have several outputs, or diverge")
    if np.max(np.abs(many + 3.0 * one)) > LINEAR * np.max(np.abs(one)):
        raise ValueError(
            f"the dynamics of {source} are not linear: they cannot be held"
        )


def bound_text(bound: ErrorBound | None, dt: float) -> str:
    """Return a text on the ``bound`` of a plant with the sample time ``dt`` (s)."""
    rate = f"the plant runs at {1.0 / dt:.6g} Hz"
    if bound is None:
        return f"{rate}; the record does not bound its error"
    excited = np.asarray(bound.relative)[np.asarray(bound.excited)]
    return (
        f"{rate}; with both records its response is known up to {bound.highest:.4g} "
        f"Hz, within {100.0 * np.median(excited):.2g} % in the median and "
        f"{100.0 * excited.max():.2g} % at worst"
    )


def combined_bound(
    slow: ErrorBound | None, fast: ErrorBound | None, dt: float
) -> ErrorBound | None:
    """Return the bound of a plant that was identified from two records.

    ``slow`` is that of the whole plant on the record of hysteresis and creep, ``fast``
    that of the dynamics that were held. At lines that the slow record excites, its
    bound holds. Elsewhere the errors of hysteresis and dynamics are combined. That of
    the hysteresis is taken as one factor at all these lines: the least bound in the
    highest decade of the slow record. ``dt`` (s) is the sample time of the plant.
    Returns None if the slow record has no bound or excites nothing.
    """
    if slow is None or not any(slow.excited):
        return None
    nyquist = 0.5 / dt
    if fast is None:
        fast = ErrorBound(frequency=(nyquist,), relative=(UNSEEN,), excited=(False,))
    lines, relative, excited = (
        np.asarray(each) for each in (slow.frequency, slow.relative, slow.excited)
    )
    near = excited & (lines >= slow.highest / DECADE)
    static = float(relative[near].min())
    every = np.unique(np.r_[lines[excited], fast.frequency, nyquist])
    every = every[every <= nyquist]
    dynamic = fast.at(every)
    total = (1.0 + static) * (1.0 + dynamic) - 1.0
    total = np.where(dynamic < UNSEEN, total, np.maximum(dynamic, UNSEEN))
    seen = (every <= slow.highest) & slow.excited_at(every)
    total = np.where(seen, slow.at(every), total)
    known = seen | fast.excited_at(every)
    if every.size > MOST_LINES:
        every, total, known = banded(every, total, known)
    return ErrorBound(
        frequency=tuple(map(float, every)),
        relative=tuple(map(float, total)),
        excited=tuple(map(bool, known)),
    )
