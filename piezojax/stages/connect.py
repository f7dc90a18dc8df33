"""Stage by its name: an address, or a function of a lab's own module."""

import importlib

from .nv200_stage import nv200_stage
from .protocol import Stage
from .remote import RemoteStage

DEVICES = {"nv200": nv200_stage}
"""Functions that connect to a device, by the prefix of its address."""


def stage_of(name: str) -> Stage:
    """Return the stage at ``name``.

    It is "host:port", "nv200:host" of a device in ``DEVICES``, or "module:function".
    The function has no argument and returns a Stage. Raises ValueError for another
    name, a missing module or function, and a function that does not return a stage.
    """
    device, _, address = name.partition(":")
    if device in DEVICES:
        return DEVICES[device](address)
    place, _, what = name.rpartition(":")
    if not (place and what):
        raise ValueError(
            f"--stage is {name!r}; give host:port (such as 127.0.0.1:5025), "
            "nv200:host, or module:function of your own stage"
        )
    if what.isdigit():
        return RemoteStage(name)
    try:
        found = getattr(importlib.import_module(place), what)()
    except (ImportError, AttributeError) as error:
        raise ValueError(f"--stage {name}: {error}") from None
    if not isinstance(found, Stage):
        raise ValueError(
            f"--stage {name} returns a {type(found).__name__}, which is no stage: it "
            "needs dt, run, apply, gains and safe"
        )
    return found
