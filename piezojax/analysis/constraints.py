"""Constraints on tuned gains: definitions, values and violations."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import largest
from .loop_figures import LoopFigures, MarginFigures
from .stability.operating_point import BRANCHES
from .stability.sampled_margins import BANDS, UNLIMITED_DELAY, UNLIMITED_GAIN
from .step_response import NAMES as STEPS

OFF = "off"
"""Limit in a study that switches a constraint off."""

CAP = 3.0
"""ln(value/limit) above which a violation is compressed. Such a loop is usually
unstable, and the size of its violation has no meaning."""


Source = Literal["tracking", "extremes", "margins", "steps"]
"""Field of ``LoopFigures`` from which a constraint is evaluated."""


class Constraint(NamedTuple):
    """Definition of a constraint: unit, direction and constrained figure.

    ``values(source, dt)`` returns the values of the figure, with the plants on the
    first axis, from the field ``source`` of the LoopFigures and dt in s. A limit must
    lie above ``above`` and below ``below``. ``default`` is the limit if a study gives
    none. ``one_axis`` is True if the figure is defined for one axis only. ``bands`` is
    the number of values for each plant and branch. ``meaning`` describes the figure,
    ``remedy`` is the advice if it violates its limit, in place of that to search again.
    ``unlimited`` is the value of a margin if no change of its kind makes the loop
    unstable.
    """

    unit: str
    sense: Literal["at most", "at least"]
    source: Source
    values: Callable[[Any, float], Array]
    above: float = 0.0
    below: float = math.inf
    default: float | None = None
    one_axis: bool = False
    bands: int = 1
    meaning: str = "Figure of another package"
    remedy: str = ""
    unlimited: float = math.inf

    def number(self, value: float) -> str:
        """Return ``value`` in four digits, or "unlimited" if nothing limits it."""
        return "unlimited" if value >= self.unlimited else f"{value:.4g}"

    def quantity(self, value: float) -> str:
        """Return the ``number`` of ``value`` with its unit, if it has one."""
        plain = self.unit == "1" or value >= self.unlimited
        return self.number(value) + ("" if plain else f" {self.unit}")

    def check(self, name: str, limit: Any) -> None:
        """Raise ValueError unless ``limit`` is a number in its bounds, or ``OFF``."""
        if limit == OFF:
            return
        number = isinstance(limit, int | float) and not isinstance(limit, bool)
        if not (number and self.above < limit < self.below):
            bound = f" and below {self.below:g}" if math.isfinite(self.below) else ""
            raise ValueError(
                f"{name} is {limit!r}; it must be a number above {self.above:g}{bound}"
                f", or {OFF!r}"
            )

    def read(self, loop: LoopFigures) -> Array:
        """Return the values [plants], or with further axes, in ``unit``."""
        return self.values(getattr(loop, self.source), loop.dt)

    def worst(self, values: Array, axis: int | None = None) -> Array:
        """Return the largest of ``values`` for an upper limit, else the smallest."""
        pick = {"at most": jnp.max, "at least": jnp.min}[self.sense]
        return pick(values, axis=axis)


def _largest(runs: Array) -> Array:
    """Return the largest value [plants] of ``runs`` [plants, references, draws]."""
    return largest(runs.reshape(runs.shape[0], -1))


def without_unstable(margins: MarginFigures, stable: Any) -> MarginFigures:
    """Return ``margins`` in which a plant that is not ``stable`` [plants] has none.

    A truncated impulse response says nothing about a loop that is barely unstable.
    """

    def of(name: str, values: Array) -> Array:
        none = jnp.inf if CONSTRAINTS[name].sense == "at most" else 0.0
        known = jnp.asarray(stable).reshape(-1, *[1] * (values.ndim - 1))
        return jnp.where(known, values, none)

    return {name: of(name, values) for name, values in margins.items()}


def _margin(name: str) -> Callable[[MarginFigures, float], Array]:
    return lambda found, dt: found[name]


CONSTRAINTS: dict[str, Constraint] = {
    "sensitivity_peak": Constraint(
        "1",
        "at most",
        "margins",
        _margin("sensitivity_peak"),
        above=1.0,
        default=2.0,
        bands=BANDS,
        meaning="Largest |S|",
    ),
    "disk_margin": Constraint(
        "1",
        "at least",
        "margins",
        _margin("disk_margin"),
        below=2.0,
        meaning="Size of the simultaneous changes of gain and phase that keep the loop "
        "stable",
    ),
    "delay_margin": Constraint(
        "samples",
        "at least",
        "margins",
        _margin("delay_margin"),
        default=1.0,
        meaning="Smallest delay that makes the loop unstable",
        unlimited=UNLIMITED_DELAY,
    ),
    "peak_voltage": Constraint(
        "V",
        "at most",
        "tracking",
        lambda figures, dt: _largest(figures.peak_voltage),
        meaning="Largest absolute voltage of the runs",
    ),
    "peak_slew": Constraint(
        "V/s",
        "at most",
        "extremes",
        lambda found, dt: _largest(found.peak_slew) / dt,
        meaning="Largest rate of the voltage in the runs, after references.settle",
        remedy="record faster motions (python -m piezojax.excite), give the slew rate "
        "of the amplifier instead (actuator.slew_rate)",
    ),
    "effort": Constraint(
        "V rms",
        "at most",
        "tracking",
        lambda figures, dt: _largest(figures.rms_effort),
        meaning="Largest rms voltage of the runs",
    ),
    "overshoot": Constraint(
        "1",
        "at most",
        "extremes",
        lambda found, dt: _largest(found.overshoot),
        meaning="Largest displacement above the highest reference or below the lowest, "
        "as a share of the reference's range",
    ),
    "gain_margin": Constraint(
        "dB",
        "at least",
        "margins",
        _margin("gain_margin"),
        meaning="Smallest gain factor above 1 that makes the loop unstable",
        unlimited=UNLIMITED_GAIN,
    ),
    "phase_margin": Constraint(
        "deg",
        "at least",
        "margins",
        _margin("phase_margin"),
        below=180.0,
        meaning="Smallest phase lag or lead that makes the loop unstable",
        unlimited=180.0,
    ),
    "bandwidth": Constraint(
        "Hz",
        "at least",
        "margins",
        _margin("bandwidth"),
        one_axis=True,
        meaning="Lowest frequency at which |y/r| falls below -3 dB",
    ),
    "closed_loop_peak": Constraint(
        "1",
        "at most",
        "margins",
        _margin("closed_loop_peak"),
        one_axis=True,
        meaning="Maximum of |y/r|",
    ),
    "rise_time": Constraint(
        "s",
        "at most",
        "steps",
        lambda found, dt: found.rise_time,
        one_axis=True,
        meaning="Time from 10 to 90 % of a step",
    ),
    "settling_time": Constraint(
        "s",
        "at most",
        "steps",
        lambda found, dt: found.settling_time,
        one_axis=True,
        meaning="Time after which a step stays within 2 % of the reference",
    ),
    "steady_state_error": Constraint(
        "1",
        "at most",
        "steps",
        lambda found, dt: found.steady_state_error,
        one_axis=True,
        meaning="Mean absolute error in the last tenth of a step, as a share of its "
        "height",
    ),
}
"""Constraints by their name in a study; each holds for every plant and reference of the
objective. The margins, the bandwidth and the peak of y/r are those of the loop
linearised at the ``margin_reference`` of the case, on both branches. For a fitted
plant the sensitivity peak and the delay margin are the worst within the error bound of
its model. On several axes the sensitivity peak is the largest singular value of S, and
the disk margin is a lower bound for simultaneous changes of all axes. The gain, phase
and delay margins are those of the worst axis with the others closed. The rise time, the
settling time and the steady-state error are those of the worst of four steps without
noise (``step_response``)."""


def limits_of(written: Mapping[str, Any]) -> dict[str, float]:
    """Return the limits in force: those ``written`` in a study, and the defaults.

    A default applies unless the study sets another limit. A limit that is written as
    ``OFF`` is left out.
    """
    defaults = {
        name: kind.default
        for name, kind in CONSTRAINTS.items()
        if kind.default is not None
    }
    chosen = defaults | dict(written)
    return {name: limit for name, limit in chosen.items() if limit != OFF}


def uses(names: Iterable[str], source: Source) -> bool:
    """Return whether any of the constraints ``names`` is evaluated from ``source``."""
    return any(CONSTRAINTS[name].source == source for name in names)


def constraint_count(names: Iterable[str], plants: int, margin_plants: int) -> int:
    """Return the number of ``violations`` of the limits ``names``.

    ``plants`` and ``margin_plants`` are numbers of plants. A limit on runs counts once
    for each of ``plants``, a limit on steps once for each of ``plants`` and each step.
    A limit on margins counts once for each of ``margin_plants`` and each branch; the
    limit on the sensitivity peak counts once for each of these and each band.
    """
    each = {
        "margins": margin_plants * len(BRANCHES),
        "steps": plants * len(STEPS),
        "tracking": plants,
        "extremes": plants,
    }
    kinds = [CONSTRAINTS[name] for name in names]
    return sum(each[kind.source] * kind.bands for kind in kinds)


def violations(
    limits: Mapping[str, Array | float], loop: LoopFigures
) -> Float[Array, " constraints"]:
    """Return the ``excess`` over each of ``limits`` on each plant, step or branch.

    The values are in the order of ``limits``; ``constraint_count`` is their number.
    """
    found = [
        excess(name, limit, CONSTRAINTS[name].read(loop)).ravel()
        for name, limit in limits.items()
    ]
    return jnp.concatenate(found) if found else jnp.zeros(0)


def excess(
    name: str, limit: Array | float, values: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Return ln(value/limit), with the opposite sign for a lower limit.

    A result above 0 is a violation. An infinite or undefined value counts as a large
    violation. A result x above ``CAP`` is compressed to CAP (1 + ln(x/CAP)).
    """
    sign = 1.0 if CONSTRAINTS[name].sense == "at most" else -1.0
    by = sign * (jnp.log(jnp.maximum(values, 1e-12)) - jnp.log(limit))
    by = jnp.where(jnp.isfinite(by), by, 100.0 * CAP)
    far = by > CAP
    slow = CAP * (1.0 + jnp.log(jnp.where(far, by, CAP) / CAP))
    return jnp.where(far, slow, by)


def worst_excess(
    limits: Mapping[str, float], margins: MarginFigures
) -> Float[Array, " plants"]:
    """Return the largest ``excess`` of the ``margins`` on each plant."""
    found = [
        jnp.max(excess(name, limits[name], values), axis=range(1, values.ndim))
        for name, values in margins.items()
    ]
    return jnp.max(jnp.stack(found), axis=0)


def worst_by_plant(limits: Iterable[str], loop: LoopFigures) -> dict[str, Array]:
    """Return the worst value [plants] of each constrained figure."""
    found = {}
    for name in limits:
        values = CONSTRAINTS[name].read(loop)
        values = values.reshape(values.shape[0], -1)
        found[name] = CONSTRAINTS[name].worst(values, axis=1)
    return found
