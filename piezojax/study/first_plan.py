"""Plan of a first study: the values that it needs besides a record."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..control.devices.e727 import STRUCTURES, UNKNOWN
from ..core.arrays import check_option
from ..identification import Record
from ..identification.records.recognise import noise_rms
from ..identification.records.response import FrequencyResponse
from ..signals import signal, time_grid
from ..signals.missing_hysteresis import TYPICAL_WIDTH
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
"""Default limits of slew and acceleration, relative to the largest of the references.
"""

RECORDED = 0.7
"""Largest slew of the default references, as a share of that of the record, with the
mean slope of the hysteresis loop: its local slopes are steeper."""

BEYOND = 0.1
"""Share of the recorded range by which references or limits may exceed it."""

NOISY, QUIET = 0.05, 3e-7
"""Shares of the recorded span above and below which the noise is doubtful."""

LOUD = 20.0
"""Ratio of the given noise to the recorded one above which it is doubtful."""

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

MEASURE = (
    "measure it (python -m piezojax.identify LOOP --controller {}, with a record of "
    "error and voltage, docs/devices.md) and give it as --{}"
)
"""How a property of a device is found; the names of device and option are left out."""

_POSITIVE = {
    "frequency": "Hz",
    "amplitude": "um",
    "slew": "um/s",
    "acceleration": "um/s^2",
}

_CONSTANT = ("STEP", "CONST")
"""References without a frequency."""

UNSEEN = ("SIN", "SCAN")
"""Kinds of the default references that only evaluate the tuned gains."""


@dataclass(frozen=True)
class Shown:
    """What a measurement shows of a stage.

    ``inputs`` (V) and ``outputs`` (um) are the lowest and highest values, ``dt`` is the
    sample time of the loop, s, ``noise`` the rms noise of the sensor, um, and ``slew``
    the largest slew rate of the voltage, V/s. These two are None if a measurement does
    not show them. ``hysteresis`` is the relative width of the loop that is to be
    assumed, None if the measurement shows the loop.
    """

    inputs: tuple[float, float]
    outputs: tuple[float, float]
    dt: float
    noise: float | None = None
    slew: float | None = None
    hysteresis: float | None = None

    @classmethod
    def by_record(cls, record: Record) -> "Shown":
        """Return what ``record``, in V and um, shows; the noise is ``noise_rms``."""
        return cls(
            (float(record.input.min()), float(record.input.max())),
            (float(record.output.min()), float(record.output.max())),
            record.dt,
            noise_rms(record),
            float(record.slews[0]),
        )

    @classmethod
    def by_response(
        cls, response: FrequencyResponse, dt: float, answers: dict[str, Any]
    ) -> "Shown":
        """Return what ``response``, in um/V, and the answers to UNSHOWN show.

        The displacement is that of the response at the lowest frequency.

        Raises ValueError if one of UNSHOWN is not in ``answers``.
        """
        if missing := [name for name in UNSHOWN if answers.get(name) is None]:
            named = " and ".join(f"--{name}" for name in missing)
            raise ValueError(f"a frequency response does not show these: give {named}")
        lower, upper = answers["lower"], answers["upper"]
        slowest = response.values[0]
        gain = float(np.copysign(np.abs(slowest), slowest.real))
        low, high = sorted((gain * lower, gain * upper))
        return cls((lower, upper), (low, high), dt, hysteresis=TYPICAL_WIDTH)


UNSHOWN = "lower", "upper", "noise"
"""Answers that a frequency response does not suggest."""


@dataclass(frozen=True)
class Plan:
    """Values that a first study needs besides a record, in V, um and Hz.

    ``lower`` and ``upper`` are the limits of the voltage, ``noise`` is the rms noise of
    the sensor, ``track`` names the references to tune on, as "SIN10,PWSW40", and
    ``frequency`` is that of the slowest one. The references cover ``offset`` to
    ``offset + 2 amplitude``. The controller follows at most the slew ``slew``, um/s,
    and the acceleration ``acceleration``, um/s^2: it sees faster references, such as
    jumps, as smooth motions. ``controller`` is the name of a design. A device limits
    the slew alone; for it, ``scale`` is that of its gains (V/um; 0 if it is unknown and
    to be assumed), and its positions range from ``lowest`` to ``highest``.
    ``structure`` is that of the PID of an E-727, None for other controllers.
    ``slew_rate`` is the largest one of the voltage, V/s; 0 is no limit.
    ``hysteresis`` is the relative width of the loop that the stage is assumed to have
    beyond the plant, None to assume none. Raises ValueError for values that no stage
    can have, and for unknown references or designs.
    """

    lower: float
    upper: float
    noise: float
    frequency: float
    track: str
    amplitude: float
    offset: float
    slew: float
    acceleration: float
    controller: str = "inversion_sliding_mode"
    scale: float = 0.0
    lowest: float = 0.0
    highest: float = 1.0
    slew_rate: float = 0.0
    hysteresis: float | None = None
    structure: str | None = None

    def __post_init__(self):
        one_of(self.controller, ALL_DESIGNS)
        if self.structure is not None:
            check_option("structure", self.structure, STRUCTURES)
            if self.controller != "e727":
                raise ValueError(
                    "structure is that of the PID of an e727, and the controller is "
                    f"{self.controller}: leave it out"
                )
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is float and not np.isfinite(value):
                raise ValueError(f"{field.name} is {value}; it must be a number")
        for name, unit in _POSITIVE.items():
            if getattr(self, name) <= 0.0:
                raise ValueError(
                    f"{name} is {getattr(self, name):g} {unit}; it must be above 0"
                )
        for name, unit in (("noise", "um"), ("scale", "V/um"), ("slew_rate", "V/s")):
            if getattr(self, name) < 0.0:
                raise ValueError(
                    f"{name} is {getattr(self, name):g} {unit}; it must be at least 0"
                )
        if self.hysteresis is not None and not 0.0 <= self.hysteresis < 0.5:
            raise ValueError(
                f"hysteresis is {self.hysteresis:g}; the width of a loop is at least 0 "
                "and below 0.5 times its height"
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


def planned(shown: Shown, given: dict[str, Any]) -> Plan:
    """Return the Plan that a measurement, ``shown``, suggests.

    Values of ``given`` that are not None replace the suggested ones. The limits are the
    lowest and highest voltage, and the references lie around the middle of the
    displacements. The slowest has at least ``SAMPLES_A_PERIOD`` samples in a period,
    and needs at most ``RECORDED`` times the largest slew that is shown, which limits
    that of the voltage. The limits of slew and acceleration of the references are
    ``FASTER`` times their largest ones.

    Raises ValueError as ``Plan`` does, and for references outside the displacements.
    """
    known = {name: value for name, value in given.items() if value is not None}
    low, high = shown.outputs
    amplitude = known.get("amplitude", _rounded(SHARE * (high - low)))

    # The limits of the references follow from a plan without them.
    def plan_of(frequency: float, slew: float = 1.0, acceleration: float = 1.0) -> Plan:
        suggested = {
            "lower": _rounded(shown.inputs[0]),
            "upper": _rounded(shown.inputs[1]),
            "noise": _rounded(shown.noise or 0.0),
            "frequency": frequency,
            "track": f"SIN{frequency:g},PWSW{4.0 * frequency:g}",
            "amplitude": amplitude,
            "offset": _rounded(0.5 * (low + high) - amplitude),
            "slew": _rounded(slew),
            "acceleration": _rounded(acceleration),
            "lowest": _rounded(low),
            "highest": _rounded(high),
            "slew_rate": _rounded(shown.slew or 0.0),
            "hysteresis": shown.hysteresis,
            "structure": UNKNOWN if known.get("controller") == "e727" else None,
        }
        return Plan(**(suggested | known))

    highest = 1.0 / (SAMPLES_A_PERIOD * shown.dt)
    plan = plan_of(known.get("frequency", _round_below(highest)))
    if "frequency" not in known and shown.slew is not None:
        gain = (high - low) / (shown.inputs[1] - shown.inputs[0])
        recorded = RECORDED * shown.slew * gain
        fastest, _ = _limits(plan, shown.dt)
        if fastest > recorded:
            plan = plan_of(_round_below(plan.frequency * recorded / fastest))
    plan = plan_of(plan.frequency, *_limits(plan, shown.dt))
    least, most = plan.offset, plan.offset + 2.0 * plan.amplitude
    beyond = BEYOND * (high - low)
    if least < low - beyond or most > high + beyond:
        raise ValueError(
            f"the references cover {least:.4g} to {most:.4g} um (offset to offset + 2 "
            f"amplitude), the measured stage {low:.4g} to {high:.4g} um: change "
            "amplitude or offset, or measure the whole range"
        )
    return plan


def _limits(plan: Plan, dt: float) -> tuple[float, float]:
    """Return the limits of slew (um/s) and acceleration (um/s^2) of the references.

    They are ``FASTER`` times the largest ones of ``plan``; ``dt`` in s.
    """
    time = time_grid(PERIODS / plan.frequency, 1.0 / dt)
    names = (*plan.tracked, *plan.unseen)
    runs = [signal(name, time, plan.amplitude, plan.offset) for name in names]

    def limit(order: int) -> float:
        largest = max(float(np.abs(np.diff(run, order)).max()) for run in runs)
        return FASTER * largest / dt**order

    return limit(1), limit(2)


def doubts(plan: Plan, shown: Shown) -> list[str]:
    """Return a sentence on each answer of ``plan`` that the measurement contradicts."""
    found = []
    low, high = shown.inputs
    beyond = BEYOND * (high - low)
    if plan.lower < low - beyond or plan.upper > high + beyond:
        found.append(
            f"the voltage may reach {plan.lower:g} to {plan.upper:g} V, but the record "
            f"covers {low:.4g} to {high:.4g} V: outside it the model extrapolates"
        )
    measured, span = shown.noise, shown.outputs[1] - shown.outputs[0]
    if plan.noise > NOISY * span:
        found.append(
            f"a noise of {plan.noise:g} um rms is {100.0 * plan.noise / span:.3g} % of "
            "the recorded span: is it in um, and the rms value?"
        )
    elif measured is not None and plan.noise > LOUD * measured:
        found.append(
            f"the record shows a noise of about {measured:.2g} um rms, and "
            f"{plan.noise:g} um are given: are they in um?"
        )
    elif measured is not None and plan.noise < 0.1 * measured:
        found.append(
            f"the record shows a noise of about {measured:.2g} um rms, more than the "
            f"{plan.noise:g} um given: the gains may amplify it"
        )
    if measured is not None and measured < QUIET * span:
        found.append(
            f"the record shows a noise of about {measured:.2g} um rms, less than that "
            "of any sensor: if the displacement was smoothed before it was saved, use "
            "it as it was measured, because smoothing hides resonances that make a "
            "loop unstable"
        )
    if plan.controller in DEVICES and plan.scale == 0.0:
        found.append(
            "the scale of the gains of the device is unknown: it is assumed, and the "
            f"gains will have an alarm: {MEASURE.format(plan.controller, 'scale')}"
        )
    if plan.structure == UNKNOWN:
        found.append(
            "the structure of the PID of the device is unknown: it is assumed, and the "
            f"gains will have an alarm: {MEASURE.format(plan.controller, 'structure')}"
        )
    return found


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
