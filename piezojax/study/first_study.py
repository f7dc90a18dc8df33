"""First study of a stage: its record, and what the record cannot tell."""

import json
import os
from dataclasses import dataclass, fields
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..control.design import DESIGNS
from ..identification import DEFAULT, Record
from ..identification.records.recognise import noise_rms
from .tables import one_of

SHARE = 0.2
"""Default amplitude of the references, as a share of the recorded span: they cover 40 %
of it."""

SAMPLES_A_PERIOD = 1000
"""Least samples in a period of the slowest default reference."""

PERIODS = 3
"""Periods of the slowest reference in a run; the first does not count."""

AMPLIFIED = 1.5
"""Limit of the closed-loop peak if references jump."""

UNSEEN = ("SIN", "SCAN")
"""Kinds of the default references that only evaluate the tuned gains."""


@dataclass(frozen=True)
class Plan:
    """What a first study needs beside a record, in V, um and Hz.

    ``lower`` and ``upper`` are the limits of the voltage, ``noise`` is the rms noise of
    the sensor, ``track`` the references to tune on, as "SIN10,PWSW40", and
    ``frequency`` that of the slowest one. The references cover ``offset`` to ``offset +
    2 amplitude``. ``jumps`` is whether references jump in use: the loop then may not
    amplify them by more than ``AMPLIFIED``. ``controller`` is the name of a design.
    """

    lower: float
    upper: float
    noise: float
    frequency: float
    track: str
    amplitude: float
    offset: float
    jumps: bool = False
    controller: str = "inversion_sliding_mode"

    def __post_init__(self):
        one_of(self.controller, DESIGNS)
        if self.frequency <= 0.0:
            raise ValueError(
                f"the frequency is {self.frequency:g} Hz; it must be above 0"
            )


def planned(record: Record, given: dict[str, Any]) -> Plan:
    """Return the Plan that ``record``, in V and um, suggests.

    Values of ``given`` that are not None replace the suggested ones. The limits are the
    recorded voltages, the noise is that of ``noise_rms``, and the references lie in the
    middle of the recorded displacements. The slowest has at least ``SAMPLES_A_PERIOD``
    samples in a period.
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
    }
    return Plan(**(suggested | known))


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
    """Return the text of a study of ``plan``, with comments, to be put in ``folder``.

    ``record`` and ``check``, if any, are files of records with these ``columns``, the
    options of ``read_record``; ``rate`` is the sampling rate of the loop, Hz, and
    ``model`` the model to fit.
    """
    tracked = [name.strip() for name in plan.track.split(",") if name.strip()]
    doubled = [f"{kind}{2.0 * plan.frequency:g}" for kind in UNSEEN]
    keys = {"rate": "record_rate"}
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
        "tune": _toml(tracked),
        "unseen": _toml([name for name in doubled if name not in tracked]),
        "duration": _toml(PERIODS / plan.frequency),
        "settle": _toml(1.0 / plan.frequency),
        "goals": f"closed_loop_peak = {AMPLIFIED}" if plan.jumps else "",
    }
    return _TEXT.substitute(values)


_TEXT = Template("""\
# First study of a stage, written by python -m piezojax.start. To tune again after a
# change:
#     python -m piezojax.tune study.toml
# Units: um, V, s, Hz.
title = $title
rate = $rate # of the loop and of the record
seed = $seed

# Parameters to tune, with the bounds that the controller declares. [parameters] may
# give other bounds.
tune = ["controller.feedback.*"]

# The model is fitted to the first half of the record and validated on the second. A
# second record, as check = "other.csv", shows whether the model still holds.
[plant]
$plant

# Limits of the voltage. A voltage that the record lacks is outside the model.
[actuator]
lower = $lower
upper = $upper

# RMS noise of the sensor. Bandwidth, delay and bits may be given too.
[sensor]
noise_rms = $noise

# The loop starts from this design and is tuned from there.
[controller]
design = $controller

# References cover offset to offset + 2 amplitude. SIN is a sine, PWSW periods of a sine
# at 100, 100, 50 and 15 % of the amplitude, SCAN a triangle with rounded turns; the
# number is the frequency. The unseen ones only evaluate the tuned gains.
[references]
tune = $tune
unseen = $unseen
amplitude = $amplitude
offset = $offset
duration = $duration
settle = $settle

# By default the sensitivity peak is limited to 2.0 and the delay margin to one sample,
# for every stage within the error bound of the fitted model. Further goals are limits
# too, as closed_loop_peak = 1.5 for references that jump, or settling_time = 0.01.
[constraints]
$goals

[optimiser]
method = "gauss_newton"
starts = 2
candidates = 32
steps = 40
""")


def _toml(value: Any) -> str:
    """Return ``value``, text, numbers or a list of them, as TOML."""
    if isinstance(value, float):
        return repr(float(value))
    # A JSON string without escaped slashes is a basic string of TOML.
    return json.dumps(value, ensure_ascii=False)


def seen_from(folder: Path, file: Path) -> str:
    """Return the path of ``file`` as seen from ``folder``, if there is one."""
    try:
        return Path(os.path.relpath(file, folder)).as_posix()
    except ValueError:  # on another drive
        return file.absolute().as_posix()


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
