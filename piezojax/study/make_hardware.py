"""Actuator, amplifier and sensor of a study, from its tables."""

import math
from collections.abc import Callable
from typing import Any

from ..core.axes import PerAxis
from ..core.space import Range
from ..core.system import Series, System, series
from ..dynamics import AnalogLowPass, FractionalDelay
from ..hardware import Quantiser, Saturation, Sensor, SensorResponse, SlewLimit
from .schema import Study
from .stage_tables import ElectronicsTable

LONGEST = 64
"""Longest delay, in samples."""

Parts = dict[str, System]


def per_axis(study: Study, make: Callable[[int], Any]) -> Any:
    """Return ``make(0)`` on a stage with one axis, else ``make(axis)`` of each axis."""
    if study.axes is None:
        return make(0)
    return tuple(make(axis) for axis in range(study.axis_count))


def make_actuator(study: Study) -> System:
    """Return the actuator: limits, slew rate and converter.

    It maps the command (V) to the voltage (V), which the controller knows. Raises
    ValueError for a converter with less than two steps between the limits.
    """
    table = study.actuator

    def parts(axis: int) -> Parts:
        lower, upper = _of(table.lower, axis), _of(table.upper, axis)
        step = _step(table, axis, upper - lower)
        found: Parts = {"limits": _limits(lower, upper, step)}
        rate = slew_rate(study, axis)
        if rate is not None:
            found["slew"] = SlewLimit(rate, study.dt)
        return found | _converter(step)

    return _systems(study, parts)


def _limits(lower: float, upper: float, step: float | None) -> Saturation:
    """Return the limits, which are steps of the converter if there is one.

    From another limit, the converter could round to a step beyond it.
    """
    inner = Range(lower, upper, step=step).inside()
    if inner.lower >= inner.upper:
        raise ValueError(
            f"actuator: the converter has steps of {step:g} V, less than two of them "
            f"from {lower:g} to {upper:g} V: give more bits or a smaller resolution"
        )
    return Saturation(inner.lower, inner.upper)


def make_amplifier(study: Study) -> System | None:
    """Return the delay and the bandwidth between actuator and plant, V to V.

    The controller does not know the output voltage. Returns None if the study has
    neither delay nor bandwidth. Raises ValueError for a delay above ``LONGEST``
    samples.
    """
    table = study.actuator

    def parts(axis: int) -> Parts:
        return _response(
            study, "actuator", table, axis, order=1, samples=table.computation
        )

    given = any(parts(axis) for axis in range(study.axis_count))
    return _systems(study, parts) if given else None


def driven(amplifier: System | None, plant: System) -> System:
    """Return ``plant`` behind ``amplifier``.

    The parts of a Series keep their paths; any other plant becomes the part ``stage``.
    """
    if amplifier is None:
        return plant
    if not isinstance(plant, Series):
        return series(amplifier=amplifier, stage=plant)
    names = plant.names or tuple(str(i) for i in range(len(plant.parts)))
    return Series((amplifier, *plant.parts), ("amplifier", *names))


def make_sensor(study: Study) -> System:
    """Return the sensor, which maps a displacement and a noise draw to a measurement.

    Raises ValueError for a delay above ``LONGEST`` samples.
    """
    table = study.sensor

    def parts(axis: int) -> Parts:
        found: Parts = {}
        response = _response(study, "sensor", table, axis, order=3)
        if response:
            found["response"] = SensorResponse(series(**response))
        found["noise"] = Sensor(_of(table.noise_rms, axis))
        cut_off = _of(table.anti_aliasing, axis)
        if cut_off is not None:
            order = table.anti_aliasing_order or 1
            found["anti_aliasing"] = AnalogLowPass(cut_off, study.dt, order)
        return found | _converter(_step(table, axis))

    return _systems(study, parts)


def _systems(study: Study, parts: Callable[[int], Parts]) -> System:
    systems = per_axis(study, lambda axis: series(**parts(axis)))
    return PerAxis(systems, study.axes.names) if study.axes else systems


def _of(value: Any, axis: int) -> Any:
    """Return the ``value`` of one axis; a single value, or None, applies to all."""
    return value[axis] if isinstance(value, tuple) else value


def slew_rate(study: Study, axis: int) -> float | None:
    """Return the lower of the slew rate and the current over the capacitance, V/s.

    None if the study limits neither.
    """
    table = study.actuator
    current = _of(table.current_limit, axis)
    rates = [_of(table.slew_rate, axis)]
    if current is not None:
        rates.append(current / _of(table.capacitance, axis))
    return min((rate for rate in rates if rate is not None), default=None)


def _step(
    table: ElectronicsTable, axis: int, span: float | None = None
) -> float | None:
    """Return the step of the converter, or None if there is none.

    Its bits divide the range, by default ``span``.
    """
    if table.bits is not None:
        return (_of(table.range, axis) or span) / 2**table.bits
    return _of(table.resolution, axis)


def _converter(step: float | None) -> Parts:
    return {} if step is None else {"converter": Quantiser(step)}


def _response(
    study: Study,
    name: str,
    table: ElectronicsTable,
    axis: int,
    order: int,
    samples: float = 0.0,
) -> Parts:
    """Return delay and low-pass, if given; ``samples`` are added to the delay.

    ``order`` is that of FractionalDelay: 1 for a voltage, 3 for a displacement.
    """
    parts: Parts = {}
    delay = samples + _of(table.delay, axis) / study.dt
    if delay > LONGEST:
        raise ValueError(
            f"{name}: the delay is {delay:g} samples of {study.dt:g} s; "
            f"it must be at most {LONGEST}"
        )
    if delay > 0.0:
        # An ensemble may draw a delay of up to twice the nominal one.
        longest = min(LONGEST, 2 * math.ceil(delay))
        parts["delay"] = FractionalDelay(
            delay * study.dt, study.dt, longest, order=order
        )
    bandwidth = _of(table.bandwidth, axis)
    if bandwidth is not None:
        parts["low_pass"] = AnalogLowPass(bandwidth, study.dt, table.order or 1)
    return parts
