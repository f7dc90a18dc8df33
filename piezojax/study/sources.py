"""Systems of a study by their source: catalog, file, type or design."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from ..catalog import at_rate
from ..core.about import About
from ..core.plain import shown
from ..core.serial import from_data, read_about
from ..core.serial import load as load_system
from ..core.system import System
from .tables import one_of

_NESTED = {"catalog", "design"}
"""Sources that a table within a table with a type may have."""


def about_file(table: Mapping[str, Any], folder: Path) -> About:
    """Return the origin of the file of ``table``; an empty About for another source."""
    return read_about(folder / str(table["file"])) if "file" in table else About()


def source_error(
    table: Mapping[str, Any], where: str, allowed: Iterable[str]
) -> ValueError:
    """Return the error for a ``table`` that has not exactly one of ``allowed``."""
    return ValueError(
        f"{where} has the keys {', '.join(table) or 'none'}; "
        f"it must have exactly one of {', '.join(allowed)}"
    )


def system_of(
    table: dict[str, Any],
    where: str,
    folder: Path,
    catalog: Mapping[str, Callable[..., System]],
    rate: float,
    design: Callable[[dict[str, Any]], System] | None = None,
) -> System:
    """Build the System of a table with one source: catalog, file, type or design.

    Only a controller has a ``design``, which receives the table. A table with a type
    may contain tables with a catalog or a design: a LimitedReference may contain the
    design that it limits. Raises ValueError for a table with no source, several
    sources, or other keys.
    """

    def nested(part: dict[str, Any], where: str) -> System:
        return system_of(part, where, folder, catalog, rate, design)

    sources = {
        "catalog": lambda: at_rate(catalog, one_of(table["catalog"], catalog), rate),
        "file": lambda: _from_file(table, where, folder),
        "type": lambda: from_data(_with_parts(table, where, nested), where),
    }
    if design is not None:
        sources["design"] = lambda: design(table)
    given = [source for source in sources if source in table]
    known = {*sources, _ACCEPT} if "file" in table else set(sources)
    free = table.keys() & {"type", "design"}  # these check their other keys
    extra = set() if free else set(table) - known
    if len(given) != 1 or extra:
        fitted = ["record", "response"] if where == "plant" else []
        allowed = (*sources, *fitted)
        raise source_error(table, where, allowed)
    try:
        return sources[given[0]]()
    except ValueError as error:
        prefix = "" if str(error).startswith(where) else f"{where}.{given[0]}: "
        raise ValueError(f"{prefix}{error}") from None


def _with_parts(
    data: Any, where: str, build: Callable[[dict[str, Any], str], System]
) -> Any:
    """Return ``data``; nested tables with a catalog or design become Systems."""
    if isinstance(data, list):
        return [_with_parts(x, f"{where}.{i}", build) for i, x in enumerate(data)]
    if not isinstance(data, Mapping):
        return data
    if "type" not in data and not _NESTED.isdisjoint(data):
        return build(dict(data), where)
    return {key: _with_parts(x, f"{where}.{key}", build) for key, x in data.items()}


_ACCEPT = "accept_unsafe"
"""Key beside ``file`` that accepts a System written with an alarm."""


def _from_file(table: dict[str, Any], where: str, folder: Path) -> System:
    """Load the System of ``table["file"]``.

    Raises ValueError for a file written with an alarm, unless the table accepts it.
    """
    path, accept = folder / str(table["file"]), table.get(_ACCEPT, False)
    if not isinstance(accept, bool):
        raise ValueError(
            f"{where}.{_ACCEPT} is {shown(accept)}; it must be true or false"
        )
    if not accept:
        remedy = f"set {where}.{_ACCEPT} = true to use it anyway"
        read_about(path).require_safe(path.name, remedy)
    return load_system(path, accept_unsafe=True)
