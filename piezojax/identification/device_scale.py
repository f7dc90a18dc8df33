"""Scale of a device's gains, measured from its own record of error and voltage."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from ..control.devices import E727, NV200, Device
from ..core.arrays import check_option
from ..core.conversion import factor
from .records.record import Record

LAGS = 6
"""Number of delays tried, from 0 samples on, of the voltage against the error."""

CLEAR = 9.0
"""Least difference of chi^2 that distinguishes two values of an option."""

UNEXPLAINED = 0.05
"""Largest share of the voltage that the gains may leave unexplained."""

LIMITS: dict[str, Any] = {"avmin": -1e6, "avmax": 1e6, "posmin": 0.0, "posmax": 1.0}


def _nv200(option: str, **typed: Any) -> Device:
    return NV200(**typed, integration=option, scale=1.0, **LIMITS)


def _e727(option: str, **typed: Any) -> Device:
    if "proportional" not in typed:
        raise ValueError("give proportional: every gain of the e727 depends on it")
    given: dict[str, Any] = {"integral_time": 0.0} | typed
    return E727(**given, structure=option, scale=1.0, lower=-1e6, upper=1e6)


class _Known(NamedTuple):
    """Device whose scale can be measured: constructor, gains and unknown option.

    ``make`` returns the device of scale 1 for an option and the gains typed into it.
    ``option`` is a property that the manual does not specify, with the possible
    ``values``.
    """

    make: Callable[..., Device]
    gains: tuple[str, ...]
    option: str
    values: tuple[str, ...]


DEVICES = {
    "nv200": _Known(
        _nv200,
        ("kp", "ki", "kd"),
        "integration",
        ("rectangular", "trapezoidal", "half"),
    ),
    "e727": _Known(
        _e727,
        ("proportional", "integral_time", "derivative_time"),
        "structure",
        ("series", "parallel"),
    ),
}
"""Devices whose scale can be measured."""


class Measured(BaseModel):
    """A number with its standard error, in ``unit``."""

    value: float
    standard_error: float
    unit: str


class DeviceScale(BaseModel):
    """Effective gains of a device, and the scale of the numbers typed in.

    ``proportional``, ``integral`` and ``derivative`` are the effective gains of a PID
    that integrates as the ``option`` says. ``scale`` is V per um for a gain of 1.
    ``lag`` is the number of samples by which the voltage lags the error, ``residual_V``
    the rms voltage that the effective gains leave unexplained.
    """

    device: str
    option: dict[str, str]
    scale: Measured
    proportional: Measured
    integral: Measured
    derivative: Measured
    lag: int
    residual_V: float  # noqa: N815
    notes: list[str]


class _Fit(NamedTuple):
    """Gains [3] of the record with their covariance, and the residual in V."""

    gains: np.ndarray
    covariance: np.ndarray
    residual: float


def device_scale(
    device: str, record: Record, typed: Mapping[str, float]
) -> DeviceScale:
    """Return the scale of the gains of ``device``, from a ``record`` in closed loop.

    The record has the error of the loop (um) as input and the voltage (V) as output, at
    the rate of the device, with notch, low-passes and feedforward off and away from the
    limits. ``typed`` are the gains at the time, by their names. The voltage is
    P e + I sum + D (e - e1)/dt plus a constant: no model of the stage is needed.

    The value of the device's option that fits best is returned; a note names others
    that fit as well, and the record that distinguishes them. Raises ValueError for an
    unknown or missing gain, an unknown device, a wrong unit or rate, more than one
    channel, gains that are all 0, a record that does not determine them or has the
    wrong sign, and for a record that the typed gains do not explain.
    """
    check_option("device", device, DEVICES)
    known = DEVICES[device]
    if unknown := [name for name in typed if name not in known.gains]:
        raise ValueError(
            f"gains {', '.join(unknown)}: {device} has the gains "
            f"{', '.join(known.gains)}"
        )
    error, voltage = _channels(record)
    devices = {value: known.make(value, **typed) for value in known.values}
    expected = {value: _expected(device) for value, device in devices.items()}
    dt = devices[known.values[0]].dt
    if not np.isclose(record.dt, dt, rtol=1e-6, atol=0.0):
        raise ValueError(
            f"the record has a rate of {1.0 / record.dt:g} Hz, {device} runs at "
            f"{1.0 / dt:g} Hz: record every sample"
        )
    if not np.any(expected[known.values[0]]):
        raise ValueError("all gains are 0: record with at least one above 0")
    fits = [_fit(error, voltage, dt, lag) for lag in range(LAGS)]
    lag = int(np.argmin([fit.residual for fit in fits]))
    fit = fits[lag]
    swing = float(np.std(voltage))
    if fit.residual > UNEXPLAINED * swing:
        raise ValueError(
            f"a PID of the error leaves {fit.residual:.3g} V of {swing:.3g} V rms: "
            "switch notch, low-passes and feedforward off, stay within the limits, and "
            "record error and voltage in one run"
        )
    size = np.sqrt(np.diag(fit.covariance))
    weight = np.linalg.inv(fit.covariance / np.outer(size, size)) / np.outer(size, size)
    found = {o: _scaled(fit.gains, weight, v) for o, v in expected.items()}
    best = min(found, key=lambda option: found[option][2])
    scale, deviation, least = found[best]
    if scale <= 0.0:
        raise ValueError(
            "the voltage falls where the error rises: the error must be the setpoint "
            "less the position"
        )
    left = _columns(error, dt, lag)[:, :3] @ (scale * expected[best])
    unexplained = float(np.std(voltage[1 + lag :] - left))
    if unexplained > UNEXPLAINED * swing:
        raise ValueError(
            f"the gains {', '.join(f'{n} {v:g}' for n, v in typed.items())} leave "
            f"{unexplained:.3g} V of {swing:.3g} V rms: give every gain as it was when "
            "the record was made"
        )
    alike = [o for o in known.values if o != best and found[o][2] - least < CLEAR]
    notes = []
    if alike:
        notes.append(
            f"{known.option} may also be {' or '.join(alike)}: to distinguish them, "
            "record with P, I and D all above 0 and P other than 1"
        )
    trapezoid = best == "trapezoidal"
    shift = np.array([[1.0, 0.5 * dt * trapezoid, 0.0], [0, 1, 0], [0, 0, 1]])
    gains = shift @ fit.gains
    errors = np.sqrt(np.diag(shift @ fit.covariance @ shift.T))
    units = ("V/um", "V/(um s)", "V s/um")
    three = [
        Measured(value=float(value), standard_error=float(error), unit=unit)
        for value, error, unit in zip(gains, errors, units, strict=True)
    ]
    return DeviceScale(
        device=device,
        option={known.option: best},
        scale=Measured(value=scale, standard_error=deviation, unit="V/um"),
        proportional=three[0],
        integral=three[1],
        derivative=three[2],
        lag=lag,
        residual_V=fit.residual,
        notes=notes,
    )


def _channels(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return error in um and voltage in V."""
    found = []
    for side, columns, units, wanted in (
        ("error", record.inputs, record.input_units, "um"),
        ("voltage", record.outputs, record.output_units, "V"),
    ):
        ratio = factor(units[0], wanted)
        if columns.shape[1] != 1 or ratio is None:
            raise ValueError(
                f"the {side} of {record.source} has {columns.shape[1]} columns in "
                f"{units[0]}; it must be one in {wanted}: name the column with its "
                f"unit, as {side}_{wanted}"
            )
        found.append(ratio * columns[:, 0])
    return found[0], found[1]


def _expected(device: Any) -> np.ndarray:
    """Return the gains [3] of a rectangular PID equal to ``device`` of scale 1."""
    loop = device.typed().loop()
    shift = 0.5 * loop.dt if loop.integration == "trapezoidal" else 0.0
    return np.array(
        [loop.proportional - shift * loop.integral, loop.integral, loop.derivative]
    )


def _fit(error: np.ndarray, voltage: np.ndarray, dt: float, lag: int) -> _Fit:
    """Fit the gains of a rectangular PID to a voltage that lags by ``lag``."""
    columns, wanted = _columns(error, dt, lag), voltage[1 + lag :]
    size = np.linalg.norm(columns, axis=0)
    if not np.all(size > 0.0) or np.linalg.cond(columns / size) > 1e9:
        raise ValueError(
            "the error of the record does not determine the gains: record a small "
            "square wave"
        )
    solution = np.linalg.lstsq(columns / size, wanted, rcond=None)[0]
    left = wanted - columns / size @ solution
    freedom = max(wanted.size - 4, 1)
    variance = float(left @ left) / freedom
    scatter = np.linalg.inv((columns / size).T @ (columns / size))
    # Without noise only the rounding of the numbers remains.
    variance = max(variance, (1e-9 * float(np.std(wanted))) ** 2)
    covariance = variance * scatter / np.outer(size, size)
    return _Fit((solution / size)[:3], covariance[:3, :3], float(np.sqrt(variance)))


def _columns(error: np.ndarray, dt: float, lag: int) -> np.ndarray:
    """Return error, its integral, its derivative and 1, [samples - 1 - lag, 4]."""
    now, before = error[1 : error.size - lag], error[: error.size - lag - 1]
    return np.column_stack(
        [now, dt * np.cumsum(now), (now - before) / dt, np.ones_like(now)]
    )


def _scaled(
    gains: np.ndarray, weight: np.ndarray, expected: np.ndarray
) -> tuple[float, float, float]:
    """Return the scale of ``expected`` gains, its standard error, and chi^2."""
    information = expected @ weight @ expected
    scale = expected @ weight @ gains / information
    left = gains - scale * expected
    return float(scale), float(1.0 / np.sqrt(information)), float(left @ weight @ left)
