"""Alarms of devices whose gains cannot be typed in as they are."""

from collections.abc import Iterator
from typing import Any

import jax

from ..control import Device
from ..core.system import System


def device_alarms(controller: System) -> Iterator[str]:
    """Yield the cautions of every Device in ``controller``."""

    def is_device(part: Any) -> bool:
        return isinstance(part, Device)

    for part in jax.tree.leaves(controller, is_leaf=is_device):
        if is_device(part):
            yield from part.cautions
