"""Hysteresis to fit that follows a law from its last point: starts and bounds."""

from ..core.space import Range
from ..hysteresis import (
    BashashJalili,
    ColemanHodgdon,
    Duhem,
    NormalisedBoucWen,
    ShapedColemanHodgdon,
)
from .part import Extent, Part, around, rest_bounds, rests


def coleman_hodgdon(extent: Extent) -> Part:
    """Coleman-Hodgdon: y' = |x'| (a x + c y) + b x'"""
    width, slope = extent.width, extent.slope
    rest = extent.first[1] - extent.centre
    reach = 2.0 * extent.span
    return Part(
        ColemanHodgdon(
            a=slope / width,
            b=0.7 * slope,
            c=-1.0 / width,
            rest_input=extent.first[0],
            rest_output=rest,
        ),
        {
            "a": around(slope / width, 0.0, 20.0),
            "b": around(slope, 0.0, 3.0),
            "c": Range(-20.0 / width, -0.01 / width),
            **rest_bounds(extent),
            "rest_output": Range(rest - reach, rest + reach),
        },
        # Keep the slope -a/c of the loop's axis while its decay c changes.
        [
            {"c": -steep / width, "a": steep * slope / width, **before}
            for steep in (0.3, 1.0, 3.0, 8.0)
            for before in rests(extent)
        ],
        gain="b",
        own=("rest_input", "rest_output"),
    )


def shaped_coleman_hodgdon(extent: Extent) -> Part:
    """Coleman-Hodgdon with cubic shape functions: y' = |x'| (p(x) + c y) + g(x) x'"""
    width, slope = extent.width, extent.slope
    rest = extent.first[1] - extent.centre
    reach = 2.0 * extent.span
    scales = [abs(slope) / width**i for i in range(4)]
    return Part(
        ShapedColemanHodgdon(
            pull=(0.0, slope / width, 0.0, 0.0),
            slope=(0.7 * slope, 0.0, 0.0),
            c=-1.0 / width,
            rest_input=extent.first[0],
            rest_output=rest,
        ),
        {
            # A constant pull and an offset of the output are the same thing.
            **{
                f"pull.{i}": Range(-50 * s, 50 * s)
                for i, s in enumerate(scales)
                if i > 0
            },
            **{f"slope.{i}": Range(-10 * s, 10 * s) for i, s in enumerate(scales[:3])},
            "c": Range(-50.0 / width, -0.01 / width),
            **rest_bounds(extent),
            "rest_output": Range(rest - reach, rest + reach),
        },
        [
            {"c": -steep / width, "pull.1": steep * slope / width, **before}
            for steep in (1.0, 3.0, 10.0)
            for before in rests(extent)
        ],
        gain="slope.0",
        own=("rest_input", "rest_output"),
    )


def duhem(extent: Extent) -> Part:
    """Semilinear Duhem: each branch its own linear law, y' = (F + G sign x') x'"""
    # Oh and Bernstein 2005, IEEE Trans. Automat. Contr. 50(5), with one state; rising
    # and falling each have a slope, a pull and a decay of their own. A constant pull
    # that changes its sign with the branch and an offset of the output are the same.
    width, slope = extent.width, extent.slope
    rest = extent.first[1] - extent.centre
    reach = 2.0 * extent.span
    pull, size = slope / width, abs(slope)
    return Part(
        Duhem(
            reversible=((0.7 * slope, 0.0), (0.0,)),
            irreversible=((0.0, pull), (-1.0 / width,)),
            rest_input=extent.first[0],
            rest_memory=rest,
        ),
        {
            "reversible.0.0": Range(-10.0 * size, 10.0 * size),
            "reversible.0.1": Range(-20.0 * size / width, 20.0 * size / width),
            "reversible.1.0": Range(-10.0 / width, 10.0 / width),
            "irreversible.0.1": around(pull, -1.0, 50.0),
            "irreversible.1.0": Range(-50.0 / width, -0.01 / width),
            **rest_bounds(extent),
            "rest_memory": Range(rest - reach, rest + reach),
        },
        [
            {"irreversible.1.0": -steep / width, "irreversible.0.1": steep * pull}
            | before
            for steep in (1.0, 3.0, 10.0)
            for before in rests(extent)
        ],
        gain="reversible.0.0",
        own=("rest_input", "rest_memory"),
    )


def normalised_bouc_wen(extent: Extent) -> Part:
    """Normalised Bouc-Wen: a line and a bounded part, y = k_x x + k_w w"""
    width, slope = extent.width, extent.slope
    return Part(
        # A displacement lags behind its voltage for k_w of the other sign than k_x.
        NormalisedBoucWen(
            k_x=1.1 * slope,
            k_w=-0.1 * slope * width,
            rho=5.0 / width,
            sigma=1.0,
            n=1.5,
            rest_input=extent.first[0],
        ),
        {
            "k_x": around(slope, 0.0, 3.0),
            "k_w": around(slope * width, -1.0, 1.0),
            "rho": Range(0.3 / width, 100.0 / width, "log"),
            "sigma": Range(0.51, 20.0, "log"),
            "n": Range(1.0, 5.0),
            **rest_bounds(extent),
        },
        [
            {"rho": steep / width, "n": bend, **before}
            for steep in (2.0, 8.0)
            for bend in (1.2, 2.0)
            for before in rests(extent)
        ],
        gain="k_x",
        own=("rest_input",),
    )


def bashash_jalili(extent: Extent) -> Part:
    """Bashash-Jalili: exponential curves between stored extrema"""
    width, slope = extent.width, extent.slope
    if slope <= 0.0:
        raise ValueError(
            "the output falls while the input rises; the curves of bashash_jalili rise"
        )
    # The reference loop is that over the record's range; beside an offset of the
    # output only one of its two ends is free.
    lower, upper = slope * extent.low, slope * extent.high
    steepness = (0.2 / width, 100.0 / width)
    bounds: dict[str, Range] = {
        "upper_output": Range(lower + 0.3 * extent.span, lower + 3.0 * extent.span)
    }
    for branch in ("rising", "falling"):
        bounds[f"{branch}_alpha"] = Range(-0.99, 3.0)
        bounds[f"{branch}_tau"] = Range(*steepness, "log")
    return Part(
        BashashJalili(
            lower_input=extent.low,
            lower_output=lower,
            upper_input=extent.high,
            upper_output=upper,
            rising_alpha=-0.4,
            rising_tau=4.0 / width,
            falling_alpha=-0.4,
            falling_tau=4.0 / width,
        ),
        bounds,
        [
            {"rising_tau": steep / width, "falling_tau": steep / width}
            for steep in (1.5, 4.0, 12.0)
        ],
        gain="upper_output",
    )
