"""Records and models that are too poor for a promise, or of another stage.

Each case makes a Setup of promise.py by ``make(stage, kind=...)`` and degrades it.
"""

import numpy as np
from oracles import excitation, forty_stages

LIGHT = {"audited": forty_stages.audited}
LIGHT |= {f"stage {n}": lambda n=n: forty_stages.stage(n) for n in (5, 19, 23)}
"""Stages with a lightly damped mode below 800 Hz."""

NO_MODE = (
    "coleman_hodgdon+lag",
    "prandtl_ishlinskii+exponential_creep+lag",
    "shaped_coleman_hodgdon+exponential_creep+lag",
)


def with_model(make, stage, model):
    """Return a case with a model without dynamics, on a stage with a mode."""
    one = make(stage())
    one.study["plant"]["model"] = model
    return one


def of_kind(make, number, kind):
    """Return a case with a record that is too poor."""
    return make(forty_stages.stage(number), kind=kind)


def scaled(make, number, column, factor, name=None):
    """Return a case with a column in another unit or sign, under ``name``."""
    one = make(forty_stages.stage(number))
    name = name or column
    one.columns = {
        (name if key == column else key): values * (factor if key == column else 1.0)
        for key, values in one.columns.items()
    }
    for side in ("input", "output"):
        if one.study["plant"][side] == column:
            one.study["plant"][side] = name
    return one


def named(make, number, **columns):
    """Return a case with exchanged columns."""
    one = make(forty_stages.stage(number))
    one.study["plant"] |= columns
    return one


def rated(make, number, factor):
    """Return a case whose time column is ``factor`` times the time in s."""
    return scaled(make, number, "time_s", factor)


def of_another(make, number, other):
    """Return a case with the record of another stage, checked on one of this stage."""
    one = make(forty_stages.stage(number))
    own = one.stage
    voltages, readings = excitation.record(own, seed=1)
    time = own.dt * np.arange(len(voltages))
    one.check = dict(zip(one.columns, (time, voltages, readings), strict=True))
    one.study["plant"]["check"] = "check.csv"
    strange = forty_stages.stage(other)
    u, y = excitation.record(strange)
    time = np.arange(0.0, (len(u) - 1) * strange.dt, one.stage.dt)
    old = strange.dt * np.arange(len(u))
    names = one.columns
    one.columns = dict(
        zip(names, (time, *(np.interp(time, old, x) for x in (u, y))), strict=True)
    )
    return one


def case(change, *given, **named):
    return lambda make: change(make, *given, **named)


OUT, IN = "displacement_um", "input_V"

CASES = {
    f"{model.partition('+')[0]} without dynamics, {stage}": case(
        with_model, LIGHT[stage], model
    )
    for model, stage in zip(
        (*NO_MODE, NO_MODE[2]),
        ("stage 5", "stage 19", "audited", "stage 23"),
        strict=True,
    )
}
CASES |= {
    f"{kind} record, stage {number}": case(of_kind, number, kind)
    for kind, number in (
        ("slow", 5), ("slow", 13), ("slow", 23), ("timid", 4), ("timid", 29),
        ("short", 10), ("tone", 18), ("tone", 25),
    )
}  # fmt: skip
CASES |= {
    "displacement of the wrong sign, stage 1": case(scaled, 1, OUT, -1.0),
    "displacement of the wrong sign, stage 16": case(scaled, 16, OUT, -1.0),
    "displacement in nm under the name of um, stage 2": case(scaled, 2, OUT, 1e3),
    "displacement in um under the name of nm, stage 3": case(
        scaled, 3, OUT, 1.0, "displacement_nm"
    ),
    "displacement in mm under the name of um, stage 6": case(scaled, 6, OUT, 1e-3),
    "input in mV under the name of V, stage 8": case(scaled, 8, IN, 1e3),
    "input before an amplifier of 10, stage 9": case(scaled, 9, IN, 0.1),
    "input and output swapped, stage 11": case(named, 11, input=OUT, output=IN),
    "input and output swapped, stage 26": case(named, 26, input=OUT, output=IN),
    "time as the input, stage 14": case(named, 14, input="time_s"),
    "time as the input, stage 35": case(named, 35, input="time_s"),
    "input as the output, stage 31": case(named, 31, output=IN),
    "time in ms under the name of s, stage 17": case(rated, 17, 1e3),
    "time at twice the rate, stage 12": case(rated, 12, 0.5),
    "record of stage 4 for stage 10": case(of_another, 10, 4),
    "record of stage 22 for stage 30": case(of_another, 30, 22),
    "record of stage 7 for stage 0": case(of_another, 0, 7),
}
