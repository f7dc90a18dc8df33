"""Declarations of parameters in fields: unit, meaning, limits and search range."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .arrays import as_array, check

Scale = Literal["linear", "log", "logit"]

PartUnits = Mapping[str, Mapping[str, str]]
"""Units inside each part of a System, by part and by name in brackets."""

_KEY = "parameter"
_FACTOR = re.compile(r"(/)|(\[\w+\]|[A-Za-z]+)(?:\^(-?\d+|\(\d+/\d+\)))?")


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Declaration of a parameter: its unit, meaning, limits and search range.

    ``above`` and ``below`` are exclusive limits, ``least`` and ``most`` inclusive ones.
    ``typical`` is the search range if the study gives none, on ``scale``: "log" for
    positive values that span decades, "logit" for values between 0 and 1. The ``unit``
    of a pure number is "1"; a name in brackets, as in "[u]/um", stands for a unit that
    only an outer System knows (see ``System.part_units``). A frequency with
    ``below_nyquist`` must be below pi / dt in rad/s or 0.5 / dt in Hz, with the sample
    time dt of the declaring System. If it is ``switched``, it belongs to a filter that
    may be off: that limit then holds for the values of a search, and the System itself
    checks it for filters that are on. A ``whole`` parameter is an integer, such as a
    count. ``step`` is the smallest difference between two values that a device accepts.
    """

    unit: str
    meaning: str
    above: float = -np.inf
    least: float = -np.inf
    most: float = np.inf
    below: float = np.inf
    scale: Scale = "linear"
    typical: tuple[float, float] | None = None
    below_nyquist: bool = False
    switched: bool = False
    whole: bool = False
    step: float | None = None

    def at(self, dt: float) -> "Parameter":
        """Return the declaration for a System with sample time ``dt`` in s."""
        if not self.below_nyquist:
            return self
        nyquist = 0.5 / dt if self.unit == "Hz" else math.pi / dt
        return dataclasses.replace(self, below=min(self.below, nyquist))

    def with_units(self, units: Mapping[str, str]) -> "Parameter":
        """Return the declaration with the names in brackets replaced by ``units``."""
        unit = substitute_units(self.unit, units)
        return self if unit == self.unit else dataclasses.replace(self, unit=unit)

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError unless ``value`` is finite and within the limits."""
        name = name if self.unit == "1" else f"{name} in {self.unit}"
        if self.whole and not isinstance(value, int):
            raise ValueError(f"{name} is {value!r}; it must be whole")
        check(
            name,
            value,
            above=self.above,
            least=self.least,
            most=self.most,
            below=self.below,
        )

    def holds(self, values: np.ndarray) -> np.ndarray:
        """Return whether each of ``values`` is within the limits."""
        above = (values > self.above) & (values >= self.least)
        return above & (values <= self.most) & (values < self.below)


def parameter(
    unit: str,
    meaning: str,
    *,
    above: float = -np.inf,
    least: float = -np.inf,
    most: float = np.inf,
    below: float = np.inf,
    scale: Scale = "linear",
    typical: tuple[float, float] | None = None,
    below_nyquist: bool = False,
    switched: bool = False,
    whole: bool = False,
    step: float | None = None,
    converter: Callable[[Any], Any] = as_array,
    static: bool = False,
    **options: Any,
) -> Any:
    """Return a field of a System together with its declaration.

    The first arguments are those of ``Parameter``. A ``static`` field, such as a sample
    time or a count, is a plain number that cannot be tuned; ``converter`` converts the
    value of any other field. ``options`` are those of ``dataclasses.field``:
    ``default``, ``kw_only``.

    The constructor of the System checks the declared limits; tables, pictures, search
    bounds and the API page read unit, meaning and range from the declaration.
    """
    declared = Parameter(
        unit,
        meaning,
        above,
        least,
        most,
        below,
        scale,
        typical,
        below_nyquist,
        switched,
        whole,
        step,
    )
    if static:
        return eqx.field(static=True, metadata={_KEY: declared}, **options)
    return eqx.field(converter=converter, metadata={_KEY: declared}, **options)


def sample_time(**options: Any) -> Any:
    """Return the field of a sample time in s."""
    return parameter("s", "sample time", above=0.0, static=True, **options)


def substitute_units(unit: str, units: Mapping[str, str]) -> str:
    """Return ``unit`` with the names in brackets replaced by ``units`` and cancelled.

    "[v]/[s]" becomes "V s/um" for v in V and s in um/s. A unit without such a name is
    returned as it is.
    """
    if not any(f"[{name}]" in unit for name in units):
        return unit
    powers = _powers(unit, units)
    over = [_factor(base, power) for base, power in powers.items() if power > 0]
    under = [_factor(base, -power) for base, power in powers.items() if power < 0]
    numerator, denominator = " ".join(over) or "1", " ".join(under)
    if len(under) > 1:
        denominator = f"({denominator})"
    return f"{numerator}/{denominator}" if under else numerator


def _powers(unit: str, units: Mapping[str, str]) -> dict[str, Fraction]:
    """Return the exponent of each factor; all factors after the solidus divide."""
    powers: dict[str, Fraction] = {}
    sign = 1
    for solidus, factor, exponent in _FACTOR.findall(unit):
        if solidus:
            sign = -1
            continue
        known = units.get(factor.strip("[]")) if factor.startswith("[") else None
        inner = {factor: Fraction(1)} if known is None else _powers(known, {})
        for base, power in inner.items():
            total = powers.get(base, Fraction(0))
            powers[base] = total + sign * Fraction(exponent.strip("()") or 1) * power
    return powers


def _factor(base: str, power: Fraction) -> str:
    if power == 1:
        return base
    return f"{base}^{power}" if power.denominator == 1 else f"{base}^({power})"


def declarations(kind: Any) -> Iterator[tuple[str, Parameter]]:
    """Yield name and declaration of each declared field of a System or its class."""
    for field in dataclasses.fields(kind):
        if _KEY in field.metadata:
            yield field.name, field.metadata[_KEY]


def rounded(value: Any, step: float | None) -> Any:
    """Return ``value`` rounded to a multiple of ``step``; its gradient is kept.

    Without a step, ``value`` is returned unchanged.
    """
    if step is None:
        return value
    nearest = jnp.round(value / step)
    # A step such as 0.001 has a rounding error; its inverse, 1000, has none.
    count = round(1.0 / step)
    whole = abs(count * step - 1.0) < 1e-12
    nearest = nearest / count if whole else nearest * step
    return jax.lax.stop_gradient(nearest) + (value - jax.lax.stop_gradient(value))


def rounded_fields(system: Any) -> Any:
    """Return ``system`` with each declared field rounded to its step."""
    changed = {
        name: rounded(getattr(system, name), declared.step)
        for name, declared in declarations(system)
        if declared.step is not None
    }
    return dataclasses.replace(system, **changed)


def check_declared(system: Any) -> None:
    """Check every declared field of ``system``.

    Raises ValueError, naming the field, its unit, the value and the allowed range.
    """
    # The sample time comes first, because other limits may depend on it.
    for name, declared in sorted(declarations(system), key=lambda d: d[0] != "dt"):
        value = getattr(system, name)
        if value is not None:
            if declared.below_nyquist and not declared.switched:
                declared = declared.at(system.dt)
            declared.check(name, value)
