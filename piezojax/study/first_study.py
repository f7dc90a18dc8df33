"""First study of a stage, from its record and the answers of its user."""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..control.devices.servo_loop import FIXED_DT
from ..core.files import seen_from
from ..identification import DEFAULT, Record
from ..identification.records.recognise import noise_rms
from ..signals import signal, time_grid
from ..signals.waveforms import parse
from .designs import ALL_DESIGNS
from .tables import one_of

SHARE = 0.2
"""Default amplitude of the references, as a share of the recorded span: they cover 40 %
of it."""

SAMPLES_A_PERIOD = 1000
"""Smallest number of samples in a period of the slowest default reference."""

PERIODS = 3
"""Periods of the slowest reference in a run; the first does not count."""

FASTER = 1.2
"""Default limit of the slew, relative to the largest slew of the references."""

BEYOND = 0.1
"""Share of the recorded range by which references or limits may exceed it."""

NOISY = 0.05
"""Share of the recorded span above which the given noise is doubtful."""

DEVICES: dict[str, dict[str, float | None]] = {
    "nv200": {"kp": None, "ki": None, "pcf_x": None, "notchf": 1.5, "notchb": 4.0},
    "e727": {
        **dict.fromkeys(("proportional", "integral_time")),
        **dict.fromkeys(("notch_rejection_1", "notch_bandwidth_1")),
        "notch_frequency_1": 1.5,
    },
}
"""Parameters to tune of each design of a device. A number is the factor by which a
parameter may differ from the value of the design; None stands for declared bounds."""

_MEASURE = (
    "measure it (python -m piezojax.identify LOOP --controller {}, with a record of "
    "error and voltage, docs/devices.md) and give it as --scale"
)

_CONSTANT = ("STEP", "CONST")
"""References without a frequency."""

UNSEEN = ("SIN", "SCAN")
"""Kinds of the default references that only evaluate the tuned gains."""


@dataclass(frozen=True)
class Plan:
    """Values that a first study needs besides a record, in V, um and Hz.

    ``lower`` and ``upper`` are the limits of the voltage, ``noise`` is the rms noise of
    the sensor, ``track`` names the references to tune on, as "SIN10,PWSW40", and
    ``frequency`` is that of the slowest one. The references cover ``offset`` to
    ``offset + 2 amplitude``. The controller follows at most the slew ``slew``, um/s: it
    sees faster references, such as jumps, as ramps. ``controller`` is the name of a
    design. For a device, ``scale`` is that of its gains (V/um; 0 if it is unknown and
    to be assumed), and its positions range from ``lowest`` to ``highest``. Raises
    ValueError for values that no stage can have, and for unknown references or designs.
    """

    lower: float
    upper: float
    noise: float
    frequency: float
    track: str
    amplitude: float
    offset: float
    slew: float
    controller: str = "inversion_sliding_mode"
    scale: float = 0.0
    lowest: float = 0.0
    highest: float = 1.0

    def __post_init__(self):
        one_of(self.controller, ALL_DESIGNS)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is float and not np.isfinite(value):
                raise ValueError(f"{field.name} is {value}; it must be a number")
        for name, unit in (("frequency", "Hz"), ("amplitude", "um"), ("slew", "um/s")):
            if getattr(self, name) <= 0.0:
                raise ValueError(
                    f"{name} is {getattr(self, name):g} {unit}; it must be above 0"
                )
        for name, unit in (("noise", "um"), ("scale", "V/um")):
            if getattr(self, name) < 0.0:
                raise ValueError(
                    f"{name} is {getattr(self, name):g} {unit}; it must be at least 0"
                )
        for low, high, unit in (("lower", "upper", "V"), ("lowest", "highest", "um")):
            ends = getattr(self, low), getattr(self, high)
            if ends[0] >= ends[1]:
                raise ValueError(
                    f"{low} is {ends[0]:g} {unit} and {high} {ends[1]:g} {unit}; {low} "
                    f"must be below {high}"
                )
        if not self.tracked:
            raise ValueError("track names no reference, as SIN10,PWSW40")
        for name in self.tracked:
            if parse(name)[1] is None and name not in _CONSTANT:
                raise ValueError(f"track: {name} has no frequency; {name}10 has 10 Hz")

    @property
    def tracked(self) -> list[str]:
        """Names of the references to tune on."""
        return [name.strip() for name in self.track.split(",") if name.strip()]

    @property
    def unseen(self) -> list[str]:
        """Names of the references that only evaluate the tuned gains."""
        doubled = (f"{kind}{2.0 * self.frequency:g}" for kind in UNSEEN)
        return [name for name in doubled if name not in self.tracked]


def planned(record: Record, given: dict[str, Any]) -> Plan:
    """Return the Plan that ``record``, in V and um, suggests.

    Values of ``given`` that are not None replace the suggested ones. The limits are the
    lowest and highest recorded voltage, the noise comes from ``noise_rms``, and the
    references lie around the middle of the recorded displacements. The slowest has at
    least ``SAMPLES_A_PERIOD`` samples in a period. The limit of the slew is ``FASTER``
    times the largest slew of the references.

    Raises ValueError as ``Plan`` does, and for references outside the record.
    """
    known = {name: value for name, value in given.items() if value is not None}
    low, high = record.output.min(), record.output.max()
    frequency = known.get(
        "frequency", _round_below(1.0 / (SAMPLES_A_PERIOD * record.dt))
    )
    amplitude = known.get("amplitude", _rounded(SHARE * (high - low)))
    suggested = {
        "lower": _rounded(float(record.input.min())),
        "upper": _rounded(float(record.input.max())),
        "noise": _rounded(noise_rms(record)),
        "frequency": frequency,
        "track": f"SIN{frequency:g},PWSW{4.0 * frequency:g}",
        "amplitude": amplitude,
        "offset": _rounded(0.5 * (low + high) - amplitude),
        "slew": 1.0,  # until the references are known
        "lowest": _rounded(float(low)),
        "highest": _rounded(float(high)),
    }
    plan = Plan(**(suggested | known))
    if "slew" not in known:
        plan = replace(plan, slew=_rounded(FASTER * _fastest(plan, record.dt)))
    least, most = plan.offset, plan.offset + 2.0 * plan.amplitude
    beyond = BEYOND * (high - low)
    if least < low - beyond or most > high + beyond:
        raise ValueError(
            f"the references cover {least:.4g} to {most:.4g} um (offset to offset + 2 "
            f"amplitude), the record {low:.4g} to {high:.4g} um: change amplitude or "
            "offset, or record the whole range"
        )
    return plan


def _fastest(plan: Plan, dt: float) -> float:
    """Return the largest slew of the references of ``plan``, um/s; ``dt`` in s."""
    time = time_grid(PERIODS / plan.frequency, 1.0 / dt)
    return max(
        float(np.abs(np.diff(signal(name, time, plan.amplitude, plan.offset))).max())
        / dt
        for name in (*plan.tracked, *plan.unseen)
    )


def doubts(plan: Plan, record: Record) -> list[str]:
    """Return a sentence on each answer of ``plan`` that ``record`` contradicts."""
    low, high = float(record.input.min()), float(record.input.max())
    found = []
    beyond = BEYOND * (high - low)
    if plan.lower < low - beyond or plan.upper > high + beyond:
        found.append(
            f"the voltage may reach {plan.lower:g} to {plan.upper:g} V, but the record "
            f"covers {low:.4g} to {high:.4g} V: outside it the model extrapolates"
        )
    measured, span = noise_rms(record), float(np.ptp(record.output))
    if plan.noise > NOISY * span:
        found.append(
            f"a noise of {plan.noise:g} um rms is {100.0 * plan.noise / span:.3g} % of "
            "the recorded span: is it in um, and the rms value?"
        )
    elif plan.noise < 0.1 * measured:
        found.append(
            f"the record shows a noise of about {measured:.2g} um rms, more than the "
            f"{plan.noise:g} um given: the gains may amplify it"
        )
    if plan.controller in DEVICES and plan.scale == 0.0:
        found.append(
            "the scale of the gains of the device is unknown: it is assumed, and the "
            f"gains will have an alarm: {_MEASURE.format(plan.controller)}"
        )
    return found


def first_study(
    plan: Plan,
    record: Path,
    columns: dict[str, Any],
    rate: float,
    *,
    folder: Path,
    model: str = DEFAULT,
    check: Path | None = None,
    seed: int = 0,
) -> str:
    """Return the text of a study of ``plan``, with comments.

    The paths in it are relative to ``folder``, where the study is to be written.
    ``record`` and the optional ``check`` are files of records, and ``columns`` are the
    options of ``read_record`` for both; ``rate`` is the sampling rate of the loop, Hz,
    and ``model`` the model to fit. Raises ValueError for a device at another rate than
    its own, and for an E-727 without the scale of its gains.
    """
    if plan.controller == "e727" and plan.scale == 0.0:
        raise ValueError(
            f"the E-727 needs the scale of its gains: {_MEASURE.format('e727')}"
        )
    keys = {"rate": "record_rate"}
    device = plan.controller in DEVICES
    if device and not np.isclose(rate * FIXED_DT, 1.0, rtol=1e-9):
        raise ValueError(
            f"the record has {rate:g} Hz, the device {1.0 / FIXED_DT:g} Hz: record at "
            "that rate, because the interpolation by --resample would look like a "
            "resonance above half the rate of the record"
        )
    plant = {
        "record": seen_from(folder, record),
        "model": model,
        **{keys.get(k, k): v for k, v in columns.items() if v is not None},
        **({"check": seen_from(folder, check)} if check else {}),
    }
    values = {
        **{field.name: _toml(getattr(plan, field.name)) for field in fields(plan)},
        "title": _toml(f"{plan.controller} on the stage of {record.name}"),
        "rate": _toml(rate),
        "seed": _toml(seed),
        "plant": "\n".join(f"{key} = {_toml(value)}" for key, value in plant.items()),
        "controller": _controller(plan, 1.0 / rate),
        "parameters": _parameters(plan.controller),
        "tune": _toml(plan.tracked),
        "unseen": _toml(plan.unseen),
        "duration": _toml(PERIODS / plan.frequency),
        "settle": _toml(1.0 / plan.frequency),
    }
    return _TEXT.substitute(values)


_TEXT = Template("""\
# First study of a stage, written by python -m piezojax.start. To tune again after a
# change:
#     python -m piezojax.tune study.toml
# Units: um, V, s, Hz.
title = $title
rate = $rate # of the loop
seed = $seed

$parameters
# The model is fitted to the first half of the record and validated on the second. A
# second record, as check = "other.csv", shows whether the model still holds.
[plant]
$plant

# Limits of the voltage. Outside the recorded voltages the model extrapolates.
[actuator]
lower = $lower
upper = $upper

# RMS noise of the sensor. Bandwidth, delay and bits may be given too.
[sensor]
noise_rms = $noise

$controller
# References cover offset to offset + 2 amplitude. SIN is a sine, PWSW periods of a sine
# at 100, 100, 50 and 15 % of the amplitude, SCAN a triangle with rounded turns; the
# number is the frequency, Hz. The unseen ones only evaluate the tuned gains.
[references]
tune = $tune
unseen = $unseen
amplitude = $amplitude
offset = $offset
duration = $duration
settle = $settle

# By default the sensitivity peak is limited to 2.0 and the delay margin to one sample,
# for every stage within the error bound of the fitted model. Write further goals as
# limits here: settling_time = 0.01, or, if the slew is not limited, closed_loop_peak =
# 1.5.
[constraints]

[optimiser]
method = "gauss_newton"
starts = 2
candidates = 32
steps = 40
""")


_LIMITED = Template("""\
# The controller follows references up to this slew, um/s. It sees faster ones, such as
# jumps, as ramps, because a jump excites the modes of the stage through the
# feedforward. dt is 1 / rate.
[controller]
type = "LimitedReference"
slew = $slew
dt = $dt

# This design gives the controller and its gains before tuning.
[controller.controller]
design = $controller
""")

_DEVICE = Template("""\
# This design gives the parameters of the device before tuning: a slow integral and a
# notch at the strongest mode. scale, V/um, is the command for a gain of 1 and an error
# of 1 um: measure it, as docs/devices.md describes. The device follows setpoints up to
# the slew, um/s, because a jump excites the modes of the stage.
[controller]
design = $controller
scale = $scale
slew = $slew
""")


_TUNE = """\
# Parameters to tune, with the bounds that the controller declares. [parameters] may
# give other bounds.
tune = {}
"""

_WITHIN = """
# These parameters stay within a factor of the values of the design.
[parameters]
"""


def _parameters(controller: str) -> str:
    """Return the keys that name the parameters to tune as TOML."""
    if controller not in DEVICES:
        return _TUNE.format(_toml(["controller.controller.feedback.*"]))
    factors = {f"controller.{k}": factor for k, factor in DEVICES[controller].items()}
    free = [path for path, factor in factors.items() if factor is None]
    rows = [
        f'"{p}" = {{ within = {x} }}\n' for p, x in factors.items() if x is not None
    ]
    return _TUNE.format(_toml(free)) + _WITHIN + "".join(rows)


def _controller(plan: Plan, dt: float) -> str:
    """Return the tables of the controller as TOML; ``dt`` in s."""
    names = ("controller", "slew", "scale")
    values = {name: _toml(getattr(plan, name)) for name in names}
    if plan.controller not in DEVICES:
        return _LIMITED.substitute(values, dt=_toml(dt))
    text = _DEVICE.substitute(values)
    if plan.controller == "nv200":
        text += f"range = {_toml([plan.lowest, plan.highest])} # of the positions, um\n"
    return text


def _toml(value: Any) -> str:
    """Return ``value`` (a text, a number or a list of them) as TOML."""
    if isinstance(value, float):
        return repr(float(value))
    # A JSON string without escaped slashes is a basic string of TOML.
    return json.dumps(value, ensure_ascii=False)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _round_below(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is at most ``value``.

    >>> _round_below(16.0)
    10.0
    """
    decade = 10.0 ** np.floor(np.log10(value))
    step = next(step for step in (5.0, 2.0, 1.0) if step * decade <= value * 1.0001)
    return _rounded(step * decade)
