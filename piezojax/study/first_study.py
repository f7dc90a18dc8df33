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


def plant_of_record(
    record: Path,
    columns: dict[str, Any],
    folder: Path,
    *,
    model: str = DEFAULT,
    check: Path | None = None,
) -> dict[str, Any]:
    """Return the table ``[plant]`` of a study in ``folder``, fitted to ``record``.

    ``columns`` are the options of ``read_record`` for ``record`` and for ``check``, an
    optional second record; ``model`` is the model to fit.
    """
    keys = {"rate": "record_rate"}
    return {
        "record": seen_from(folder, record),
        "model": model,
        **{keys.get(k, k): v for k, v in columns.items() if v is not None},
        **({"check": seen_from(folder, check)} if check else {}),
    }


def plant_of_response(
    response: Path, folder: Path, *, unit: str | None = None, held: bool = False
) -> dict[str, Any]:
    """Return the table ``[plant]`` of a study in ``folder``, fitted to ``response``.

    ``response`` is a file of a frequency response; ``unit`` and ``held`` are the keys
    of that name.
    """
    return {
        "response": seen_from(folder, response),
        **({"unit": unit} if unit else {}),
        **({"held": True} if held else {}),
    }


def first_study(
    plan: Plan, plant: dict[str, Any], rate: float, *, seed: int = 0
) -> str:
    """Return the text of a study of ``plan``, with comments.

    ``plant`` is the table of ``plant_of_record`` or ``plant_of_response``, and ``rate``
    the sampling rate of the loop, Hz. Raises ValueError for a device at another rate
    than its own, and for an E-727 without the scale of its gains.
    """
    if plan.controller == "e727" and plan.scale == 0.0:
        raise ValueError(
            f"the E-727 needs the scale of its gains: {MEASURE.format('e727', 'scale')}"
        )
    measured = "record" if "record" in plant else "response"
    device = plan.controller in DEVICES
    if device and not np.isclose(rate * FIXED_DT, 1.0, rtol=1e-9):
        raise ValueError(_OTHER_RATE[measured].format(rate, 1.0 / FIXED_DT))
    values = {
        **{field.name: _toml(getattr(plan, field.name)) for field in fields(plan)},
        "title": _toml(
            f"{plan.controller} on the stage of {Path(plant[measured]).name}"
        ),
        "rate": _toml(rate),
        "seed": _toml(seed),
        "fitted": _FITTED[measured],
        "plant": "\n".join(f"{key} = {_toml(value)}" for key, value in plant.items()),
        "slew_rate": _SLEW_RATE.format(plan.slew_rate) if plan.slew_rate else "",
        "disturbance": "" if plan.hysteresis is None else _LOOP.format(plan.hysteresis),
        "controller": _controller(plan, 1.0 / rate),
        "parameters": _parameters(plan.controller),
        "tune": _toml(plan.tracked),
        "unseen": _toml(plan.unseen),
        "duration": _toml(PERIODS / plan.frequency),
        "settle": _toml(1.0 / plan.frequency),
    }
    return _TEXT.substitute(values)


_OTHER_RATE = {
    "record": "the record has {:g} Hz, the device {:g} Hz: record at that rate, "
    "because the interpolation by --resample would look like a resonance above half "
    "the rate of the record",
    "response": "--rate is {:g} Hz, but the device has {:g} Hz",
}

_FITTED = {
    "record": """\
# The model is fitted to the first half of the record and validated on the second. A
# second record, as check = "other.csv", shows whether the model still holds.
""",
    "response": """\
# The modes, lags and delay are fitted to the frequency response, and the margins are
# also computed on its points. It shows small motions: hysteresis and creep are not in
# this model.
""",
}

_TEXT = Template("""\
# First study of a stage, written by python -m piezojax.start. To tune again after a
# change:
#     python -m piezojax.tune study.toml
# Units: um, V, s, Hz.
title = $title
rate = $rate # of the loop
seed = $seed

$parameters
$fitted[plant]
$plant

# Limits of the voltage. Outside the measured voltages the model extrapolates.
[actuator]
lower = $lower
upper = $upper
$slew_rate
# RMS noise of the sensor. Bandwidth, delay and bits may be given too.
[sensor]
noise_rms = $noise

$disturbance$controller
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

# Limits for every stage within the error bound of the fitted model. By default the
# sensitivity peak stays below 2.0. Delay margin, in samples: readings that were saved
# one or two samples early hide as much delay. Write further goals as limits here:
# settling_time = 0.01, or, if the slew of the reference is not limited,
# closed_loop_peak = 1.5.
[constraints]
delay_margin = 2.0

[optimiser]
method = "gauss_newton"
starts = 4
candidates = 64
steps = 80
""")


_LIMITED = Template("""\
# The controller follows references up to this slew, um/s, and this acceleration,
# um/s^2. It sees faster ones, such as jumps, as smooth motions within these limits,
# because a jump excites the modes of the stage through the feedforward. dt is 1 / rate.
[controller]
type = "LimitedReference"
slew = $slew
acceleration = $acceleration
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

_STRUCTURE = """\
# "series": P multiplies all terms of the PID; "parallel": P, I and D are summed. The
# measurement of the scale finds it, too; "unknown" is simulated as "series".
structure = {}
"""

_TUNE = """\
# Parameters to tune, with the bounds that the controller declares. [parameters] may
# give other bounds.
tune = {}
"""

_WITHIN = """
# These parameters stay within a factor of the values of the design.
[parameters]
"""


_SLEW_RATE = """\
# Largest slew rate of the voltage, V/s: that of the amplifier, or of the record, which
# does not show whether the amplifier reaches more. Exported code keeps to it.
slew_rate = {!r}
"""

_LOOP = """\
# Hysteresis that the plant lacks disturbs the runs: the width of its loop, relative to
# its height, over the range of the references. 0.1 to 0.15 is typical of piezo
# ceramics; 0 is for a stage without hysteresis.
[disturbance]
hysteresis = {!r}

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
    names = ("controller", "slew", "acceleration", "scale")
    values = {name: _toml(getattr(plan, name)) for name in names}
    if plan.controller not in DEVICES:
        return _LIMITED.substitute(values, dt=_toml(dt))
    text = _DEVICE.substitute(values)
    if plan.controller == "nv200":
        text += f"range = {_toml([plan.lowest, plan.highest])} # of the positions, um\n"
    if plan.structure is not None:
        text += _STRUCTURE.format(_toml(plan.structure))
    return text


def _toml(value: Any) -> str:
    """Return ``value`` (a text, a number or a list of them) as TOML."""
    if isinstance(value, float):
        return repr(float(value))
    # A JSON string without escaped slashes is a basic string of TOML.
    return json.dumps(value, ensure_ascii=False)
