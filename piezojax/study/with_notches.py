"""Case with notches in its feedback; their parameters are tuned too."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ..control import Device, FilteredCommand
from ..core.feedback import Observation
from ..core.paths import get_part, replace_part
from ..core.recipe import Resonance
from ..core.space import Range, space_of
from ..core.system import Series, System, accepts
from ..dynamics import Notch
from .case import Case

OFF = 1.0
"""Depth of a notch that is switched off."""

SPAN = 1.1
"""Largest ratio of the frequency of a notch to that of its mode, or its inverse."""

HIGHEST = 0.49
"""Highest frequency of a notch, in cycles per sample."""

WIDTHS = 0.03, 0.8
"""Bounds of the damping ratio of the poles of a notch."""

NOTCH = "notch_{}"
"""Name of a notch by its number, from 1 on."""

_UNTUNED = 0.5  # damping ratio at the start


def with_notches(case: Case, modes: Sequence[Resonance]) -> Case:
    """Return ``case`` with a notch at each of ``modes``, and their parameters tuned.

    The notches filter the command of the part ``structures.behind``. They are switched
    off, so that the loop is that of ``case``, and the search of the study starts there.
    Their frequencies stay near those of ``modes``. Without modes the controller is that
    of the study. Raises ValueError for a part that is not a controller, and for a
    controller of a vendor, which has notches of its own.
    """
    study = case.study.model_copy(update={"structures": None})
    if not modes:
        return dataclasses.replace(case, study=study)
    place = place_of(case)
    # The start of the study, at which the notches are off, and two with notches.
    starts = max(study.optimiser.starts, 3)
    optimiser = study.optimiser.model_copy(update={"starts": starts})
    notches = tuple(Notch(mode.frequency, _UNTUNED, OFF, study.dt) for mode in modes)
    names = tuple(NOTCH.format(i) for i in range(1, len(modes) + 1))
    part = get_part(case.loop, place)
    loop = replace_part(case.loop, place, FilteredCommand(part, Series(notches, names)))
    ranges = {
        moved(path, place): bounds for path, bounds in case.space.ranges().items()
    }
    for name, mode in zip(names, modes, strict=True):
        where = f"{place}.filter.{name}"
        highest = min(SPAN * mode.frequency, HIGHEST * study.rate)
        ranges |= {
            f"{where}.frequency": Range(mode.frequency / SPAN, highest, "log"),
            f"{where}.damping": Range(*WIDTHS, "log"),
            f"{where}.depth": Range(0.0, OFF),
        }
    return dataclasses.replace(
        case,
        study=study.model_copy(update={"optimiser": optimiser}),
        loop=loop,
        space=space_of(ranges),
    )


def place_of(case: Case) -> str:
    """Return the path of the part whose command the notches filter.

    Raises ValueError as ``with_notches`` does.
    """
    table, controller = case.study.structures, case.loop.controller
    behind = table.behind if table else None
    if behind is None:
        behind = _feedback_of(controller)
    where = f"structures.behind: {behind}"
    if behind.split(".")[0] != "controller":
        raise ValueError(f"{where} must begin with 'controller'")
    try:
        part = get_part(case.loop, behind)
    except ValueError as error:
        raise ValueError(f"structures.behind: {error}") from None
    zero = jnp.zeros(())
    if not isinstance(part, System) or not accepts(
        part, Observation(zero, zero, zero, zero)
    ):
        raise ValueError(
            f"{where} is a {type(part).__name__}; "
            "it must map an Observation to a command"
        )
    devices = [
        type(node).__name__
        for node in jax.tree.leaves(part, is_leaf=_is_device)
        if _is_device(node)
    ]
    if devices:
        raise ValueError(
            f"structures: {devices[0]} has notches of its own and no place for others; "
            "tune these under [parameters]"
        )
    return behind


def _feedback_of(controller: System) -> str:
    """Return the path of the feedback in ``controller``, or "controller" without one.

    Other controllers, such as a LimitedReference, may enclose the one with feedback.
    """
    part, path = controller, "controller"
    while isinstance(inner := getattr(part, "controller", None), System):
        part, path = inner, f"{path}.controller"
    if isinstance(getattr(part, "feedback", None), System):
        return f"{path}.feedback"
    return "controller"


def moved(path: str, place: str) -> str:
    """Return the ``path`` of a parameter once notches filter the part at ``place``."""
    inner = path.removeprefix(f"{place}.")
    return path if inner == path else f"{place}.controller.{inner}"


def _is_device(node: Any) -> bool:
    return isinstance(node, Device)
