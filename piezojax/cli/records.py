"""Options of the commands that read records."""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import click
from rich.console import Console

if TYPE_CHECKING:
    import numpy as np

    from ..identification import Record


class SampleRange(click.ParamType):
    """Two sample numbers as in ``0:1200``, converted to a slice."""

    name = "START:STOP"

    def convert(self, value, param, ctx):
        """Return the slice of a text; fail with one line for any other text."""
        try:
            start, stop = (int(number) for number in value.split(":"))
        except ValueError:
            self.fail(f"{value!r} must be two sample numbers, as in 0:1200", param, ctx)
        return slice(start, stop)


_COLUMNS = {
    "time": click.option("--time", help="Time column, by name or number from zero."),
    "input": click.option(
        "--input", default="0", show_default=True, help="Input column."
    ),
    "output": click.option(
        "--output", default="1", show_default=True, help="Output column."
    ),
    "reference": click.option(
        "--reference", help="Reference column of a record of a closed loop."
    ),
    "dither": click.option(
        "--dither",
        help="Column of the voltage added to the command of the controller.",
    ),
    "rate": click.option(
        "--rate", type=float, help="Sampling rate, Hz, without a time column."
    ),
    "period": click.option(
        "--period", type=int, help="Samples per period of a periodic input."
    ),
    "resample": click.option(
        "--resample", type=float, help="Resample the record to this rate, Hz."
    ),
}

_RECOGNISED = _COLUMNS | {
    "time": click.option("--time", help="Time column (default: recognised by name)."),
    "input": click.option(
        "--input", help="Input column (default: the only one in V, mV or kV)."
    ),
    "output": click.option(
        "--output", help="Output column (default: the only one in um, nm or mm)."
    ),
}


def record_columns(function: Callable) -> Callable:
    """Add the options of ``read_record``."""
    return _with_options(function, _COLUMNS.values())


def recognised_columns(function: Callable) -> Callable:
    """Add the options of ``read_record`` for an open loop, without default columns."""
    names = ("time", "input", "output", "rate", "resample")
    return _with_options(function, [_RECOGNISED[name] for name in names])


def _with_options(function: Callable, options: Iterable[Callable]) -> Callable:
    for option in reversed([*options]):
        function = option(function)
    return function


def print_columns(console: Console, records: "Iterable[Record]") -> None:
    """Print ``columns_of`` each record."""
    for record in records:
        console.print(columns_of(record), soft_wrap=True, markup=False)


def columns_of(record: "Record") -> str:
    """Return the columns with their units and ranges, the samples and the rate."""
    sides = "; ".join(
        f"{role} {', '.join(columns)}"
        for role, columns in (
            ("input", _of(record, record.input_names, record.input_units)),
            ("output", _of(record, record.output_names, record.output_units)),
            *(
                (role, [_range(signal, unit)])
                for role, signal, unit in (
                    ("reference", record.reference, record.output_unit),
                    ("dither", record.dither, record.input_unit),
                )
                if signal is not None
            ),
        )
    )
    clock = f" ({record.clock!r} in s, assumed)" if record.clock else ""
    return (
        f"read {record.source}: {sides}; {record.samples} samples at "
        f"{1.0 / record.dt:.6g} Hz{clock}"
    )


def _of(record: "Record", names: Sequence[str], units: Sequence[str]) -> list[str]:
    columns = record.inputs if names is record.input_names else record.outputs
    return [
        f"{name!r} {_range(column, unit)}"
        + (" (assumed)" if name in record.assumed else "")
        for name, column, unit in zip(names, columns.T, units, strict=True)
    ]


def _range(column: "np.ndarray", unit: str) -> str:
    return f"from {column.min():.4g} to {column.max():.4g} {unit}"
