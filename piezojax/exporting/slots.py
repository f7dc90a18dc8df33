"""Fields and arguments of C: the scalars of a tree, by name."""

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .c_source import TYPES, Precision

PREPARED = "prepared"
"""Name of the field that holds the numbers computed from the parameters."""


class Slot(NamedTuple):
    """A scalar of a tree: its path, its name in C, and its type."""

    path: str
    name: str
    dtype: Any
    size: int = 1


class Interface(NamedTuple):
    """Signals of an exported System.

    ``start`` is an example of the input of ``init``, ``input`` one of ``step``. The
    function ``step`` has an argument for each leaf, named by its path.
    """

    start: Any
    input: Any


def slots(tree: Any, word: str) -> list[Slot]:
    """Return the leaves of ``tree``, an array as one slot of its size.

    ``word`` begins a name that has no letter of its own.
    """
    found, taken = [], {PREPARED}
    for keys, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        path = ".".join(jax.tree_util.keystr((key,), simple=True) for key in keys)
        name = re.sub(r"\W+", "_", path)
        if not name or name[0].isdigit():
            name = f"{word}_{name}".rstrip("_")
        base, count = name, 1
        while name in taken:
            count += 1
            name = f"{base}_{count}"
        taken.add(name)
        found.append(Slot(path, name, leaf.dtype, math.prod(jnp.shape(leaf))))
    return found


def expressions(slots: Sequence[Slot], start: str) -> list[str]:
    """Return the expression of every scalar of ``slots`` behind ``start``."""
    return [
        f"{start}{slot.name}" if slot.size == 1 else f"{start}{slot.name}[{i}]"
        for slot in slots
        for i in range(slot.size)
    ]


def type_of(dtype: Any, precision: Precision) -> str:
    """Return the type in C of scalars of ``dtype``."""
    if np.issubdtype(dtype, np.bool_):
        return TYPES["boolean"]
    if np.issubdtype(dtype, np.integer):
        return TYPES["integer"]
    return precision.real
