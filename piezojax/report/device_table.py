"""Table of the saved and the exported parameters of a device."""

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from ..exporting import Value


def device_table(values: Sequence[Value]) -> Table:
    """Return the saved and the exported value of each parameter; changes are bold.

    A dash stands for a parameter that the saved file lacks.
    """
    table = Table(title="parameters of the device")
    table.add_column("parameter", overflow="fold")
    for title in ("saved", "exported"):
        table.add_column(title, justify="right", overflow="fold")
    table.add_column("unit", no_wrap=True)
    table.add_column("meaning")
    for row in values:
        style = "bold" if row.saved and not _same(row.saved, row.value) else ""
        exported = Text(row.value, style=style)
        table.add_row(row.parameter, row.saved or "-", exported, row.unit, row.meaning)
    return table


def _same(one: str, other: str) -> bool:
    """Return whether two texts are the same numbers, or the same text."""
    try:
        return [*map(float, one.split(","))] == [*map(float, other.split(","))]
    except ValueError:
        return one == other
