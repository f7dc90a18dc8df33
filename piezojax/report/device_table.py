"""Table of the saved and the exported parameters of a device."""

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from ..exporting import Value


def device_table(values: Sequence[Value]) -> Table:
    """Return the value of each parameter, beside the saved one if there is any.

    Changes are bold. A dash stands for a parameter that the saved file lacks.
    """
    saved = any(row.saved for row in values)
    table = Table(title="parameters to type into the device")
    table.add_column("parameter", overflow="fold")
    for title in ("saved", "value")[not saved :]:
        table.add_column(title, justify="right", overflow="fold")
    table.add_column("unit", no_wrap=True)
    table.add_column("meaning")
    for row in values:
        style = "bold" if row.saved and not _same(row.saved, row.value) else ""
        value = Text(row.value, style=style)
        before = [row.saved or "-"] if saved else []
        table.add_row(row.parameter, *before, value, row.unit, row.meaning)
    return table


def _same(one: str, other: str) -> bool:
    """Return whether two texts are the same numbers, or the same text."""
    try:
        return [*map(float, one.split(","))] == [*map(float, other.split(","))]
    except ValueError:
        return one == other
