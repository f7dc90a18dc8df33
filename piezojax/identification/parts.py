"""Parts of which models to fit are made, by name."""

from collections.abc import Callable

from ..core.space import Range
from ..dynamics import ARMA, FirstOrderLag, FractionalDelay
from . import parts_creep as creep
from . import parts_curves as curves
from . import parts_plays as plays
from .part import Extent as Extent
from .part import Part as Part
from .part import extent_of as extent_of


def lag(extent: Extent) -> Part:
    """First-order lag: amplifier, sensor filter"""
    dt = extent.dt
    return Part(
        FirstOrderLag(dt, dt), {"time_constant": Range(0.05 * dt, 50.0 * dt, "log")}
    )


def arma(extent: Extent) -> Part:
    """Second-order dynamics (3.30) with two zeros"""
    del extent
    return Part(
        ARMA((0.9, -0.2), (0.3, 0.0, 0.0)),
        {
            "autoregressive.0": Range(-2.0, 2.0),
            "autoregressive.1": Range(-1.0, 1.0),
            **{f"moving.{i}": Range(-3.0, 3.0) for i in range(3)},
        },
        [
            {"autoregressive.0": 2.0 * p, "autoregressive.1": -p * p, "moving.0": q}
            for p, q in ((0.3, 0.49), (0.8, 0.04))
        ],
        gain="moving.0",
    )


def delay(extent: Extent) -> Part:
    """Delay of up to five samples"""
    return Part(
        FractionalDelay(0.5 * extent.dt, extent.dt, 5),
        {"delay": Range(0.0, 5.0 * extent.dt)},
        [{"delay": n * extent.dt} for n in (0.5, 2.5)],
    )


PARTS: dict[str, tuple[str, Callable[[Extent], Part]]] = {
    "coleman_hodgdon": ("hysteresis", curves.coleman_hodgdon),
    "shaped_coleman_hodgdon": ("hysteresis", curves.shaped_coleman_hodgdon),
    "prandtl_ishlinskii": ("hysteresis", plays.prandtl_ishlinskii),
    "asymmetric_prandtl_ishlinskii": (
        "hysteresis",
        plays.asymmetric_prandtl_ishlinskii,
    ),
    "stop_prandtl_ishlinskii": ("hysteresis", plays.stop_prandtl_ishlinskii),
    "rate_dependent_prandtl_ishlinskii": (
        "hysteresis",
        plays.rate_dependent_prandtl_ishlinskii,
    ),
    "duhem": ("hysteresis", curves.duhem),
    "normalised_bouc_wen": ("hysteresis", curves.normalised_bouc_wen),
    "bashash_jalili": ("hysteresis", curves.bashash_jalili),
    "learned_operator": ("hysteresis", plays.learned_operator),
    "exponential_creep": ("creep", creep.exponential_creep),
    "logarithmic_creep": ("creep", creep.logarithmic_creep),
    "spring_damper_creep": ("creep", creep.spring_damper_creep),
    "arma": ("dynamics", arma),
    "lag": ("lag", lag),
    "delay": ("delay", delay),
}
"""Parts of a chain by name: the name they have in the fitted plant, their builder."""

OWN_DYNAMICS = ("learned_operator",)
"""Hysteresis that needs no lag behind it where it stands alone."""
