"""Paths of parameters in a tree of systems: ``"controller.feedback.surface"``."""

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jax.tree_util import SequenceKey, keystr

from .arrays import as_array
from .axes import PerAxis
from .parameter import Parameter, declarations, substitute_units
from .system import Series, System

S = TypeVar("S", bound=eqx.Module)


def _children(node: Any) -> dict[str, Any]:
    if isinstance(node, Series | PerAxis) and node.names:
        return dict(zip(node.names, node.parts, strict=True))
    if isinstance(node, Series | PerAxis):
        return {str(i): part for i, part in enumerate(node.parts)}
    if isinstance(node, tuple):
        return {str(i): part for i, part in enumerate(node)}
    if isinstance(node, eqx.Module):
        names = [f.name for f in dataclasses.fields(node)]
        return {name: getattr(node, name) for name in names}
    return {}


def parameters(system: Any, prefix: str = "") -> dict[str, Any]:
    """Return the array leaves of ``system`` by path."""
    leaves = {}
    for name, child in _children(system).items():
        path = f"{prefix}{name}"
        if eqx.is_array(child):
            leaves[path] = child
        else:
            leaves.update(parameters(child, f"{path}."))
    return leaves


def leaf_path(system: Any, keys: Iterable[Any]) -> str:
    """Return the path of the leaf of ``system`` with the given keys of JAX.

    The field ``parts`` of a Series or PerAxis, which JAX counts, is not in a path.
    """
    names, node, rest = [], system, iter(keys)
    for key in rest:
        if isinstance(node, Series | PerAxis):
            key = next(rest)
        children, fields = _children(node), getattr(node, "_fields", ())
        name = keystr((key,), simple=True)
        if name in fields:  # of a NamedTuple
            name = str(fields.index(name))
        elif isinstance(key, SequenceKey) and children:
            name = list(children)[key.idx]
        names.append(name)
        node = children.get(name)
    return ".".join(names)


def scalars(system: Any) -> dict[str, float]:
    """Return the scalar parameters of ``system`` by path, as numbers."""
    found = parameters(system).items()
    return {path: float(value) for path, value in found if value.ndim == 0}


def matching(system: Any, pattern: str) -> list[str]:
    """Return the paths of the array leaves that match ``pattern``, in tree order.

    ``*`` stands for any characters, dots included: ``controller.feedback.*`` matches
    every parameter of the feedback.
    """
    return [path for path in parameters(system) if fnmatchcase(path, pattern)]


def declared(system: Any, path: str) -> Parameter | None:
    """Return the declaration of the parameter at ``path``, or None if it has none.

    The elements of a tuple, such as coefficients, share the declaration of their field.
    A limit at the Nyquist frequency uses the sample time of the declaring System. Names
    in brackets in its unit are replaced by the units that the outer Systems declare for
    them.
    """
    node: Any = system
    declaration = None
    units: Mapping[str, str] = {}
    for name in path.split("."):
        children = _children(node)
        if name not in children:
            return None
        if isinstance(node, eqx.Module):
            declaration = dict(declarations(type(node))).get(name)
            if declaration is not None and declaration.below_nyquist:
                declaration = declaration.at(children["dt"])
            if declaration is not None:
                declaration = declaration.with_units(units)
        if isinstance(node, System):
            inner = node.part_units.get(name, {})
            units = {
                **units,
                **{k: substitute_units(u, units) for k, u in inner.items()},
            }
        node = children[name]
    return declaration


def static_fields(system: Any, name: str) -> list[Any]:
    """Return the values of all fields called ``name`` in the tree of ``system``."""
    values = []
    for key, child in _children(system).items():
        values += [child] if key == name else static_fields(child, name)
    return values


def _walk(node: Any, path: str) -> Any:
    for part in path.split("."):
        node = _children(node)[part]
    return node


def get(system: eqx.Module, path: str) -> Any:
    """Return the array leaf at ``path``.

    Raises ValueError, listing the most similar paths, if there is none.
    """
    try:
        node = _walk(system, path)
    except KeyError:
        node = None
    if not eqx.is_array(node):
        raise ValueError(_unknown(system, path))
    return node


def get_part(system: Any, path: str) -> Any:
    """Return the part of ``system`` at ``path``: a System, a tuple or a leaf.

    Raises ValueError, listing the parts at the last valid path, if there is none.
    """
    node, known = system, ""
    for name in path.split("."):
        children = _children(node)
        if name not in children:
            raise ValueError(
                f"no part {path!r}; {known or 'the system'} has {', '.join(children)}"
            )
        node, known = children[name], f"{known}.{name}".lstrip(".")
    return node


def replace_part(system: S, path: str, part: Any) -> S:
    """Return ``system`` with its part at ``path`` replaced by ``part``."""
    return eqx.tree_at(lambda tree: _walk(tree, path), system, part)


def replace(system: S, values: Mapping[str, Any]) -> S:
    """Return ``system`` with the leaves at the given paths replaced."""
    if not values:
        return system
    names = list(values)
    new = [
        jnp.broadcast_to(as_array(values[name]), get(system, name).shape)
        for name in names
    ]
    return eqx.tree_at(lambda tree: [_walk(tree, name) for name in names], system, new)


def _unknown(system: eqx.Module, path: str) -> str:
    known = list(parameters(system))
    near = difflib.get_close_matches(path, known, n=3, cutoff=0.3) or known[:5]
    return f"no parameter {path!r}; the nearest are {', '.join(near)}"
