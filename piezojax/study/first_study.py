"""First study of a stage, from its record and the answers of its user."""

import json
from dataclasses import fields
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..control.devices.servo_loop import FIXED_DT
from ..core.files import seen_from
from ..identification import DEFAULT
from .first_plan import DEVICES, MEASURE, PERIODS, Plan


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
            f"the E-727 needs the scale of its gains: {MEASURE.format('e727')}"
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
