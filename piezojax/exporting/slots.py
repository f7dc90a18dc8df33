"""Struct fields and function arguments in C, one for each leaf of a pytree."""

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr

from ..core.paths import leaf_path
from ..scalar.c_source import TYPES, Precision

PREPARED = "prepared"
"""Name of the field that holds the numbers computed from the parameters."""


class Slot(NamedTuple):
    """A leaf of a pytree: its path, its name in C, its dtype, and its element count."""

    path: str
    name: str
    dtype: Any
    size: int = 1


class Interface(NamedTuple):
    """Example signals of an exported System.

    ``start`` is an input of ``init``, and ``input`` an input of ``step``. Both C
    functions have one argument for each leaf, named by its path.
    """

    start: Any
    input: Any


def slots(tree: Any, word: str) -> list[Slot]:
    """Return a slot for each leaf of ``tree``; an array is one slot.

    Its name contains the field ``parts`` of a Series or PerAxis, its path does not.

    ``word`` is the prefix of a name that is empty or begins with a digit.
    """
    found, taken = [], {PREPARED}
    for keys, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = re.sub(r"\W+", "_", keystr(keys, simple=True, separator="."))
        if not name or name[0].isdigit():
            name = f"{word}_{name}".rstrip("_")
        base, count = name, 1
        while name in taken:
            count += 1
            name = f"{base}_{count}"
        taken.add(name)
        size = math.prod(jnp.shape(leaf))
        found.append(Slot(leaf_path(tree, keys), name, leaf.dtype, size))
    return found


def expressions(slots: Sequence[Slot], start: str) -> list[str]:
    """Return the C expression of each element of ``slots``, with prefix ``start``."""
    return [
        f"{start}{slot.name}" if slot.size == 1 else f"{start}{slot.name}[{i}]"
        for slot in slots
        for i in range(slot.size)
    ]


def type_of(dtype: Any, precision: Precision) -> str:
    """Return the C type of scalars of ``dtype``."""
    if np.issubdtype(dtype, np.bool_):
        return TYPES["boolean"]
    if np.issubdtype(dtype, np.integer):
        return TYPES["integer"]
    return precision.real
