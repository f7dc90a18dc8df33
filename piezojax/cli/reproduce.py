"""``python -m piezojax.reproduce [--table T ... | --calibrate] --out DIR``."""

import json

import click

from ..core.files import write_text
from .command import Command, common, results_folder, run
from .terminal import Bar

NAMES = (
    *("3-6", "3-7"),
    *("4-5", "4-6", "figure-4-5", "figure-4-7"),
    *("5-3", "5-5"),
    *("6-7", "6-8"),
    *("7-4", "figure-7-4"),
    *("8-2", "8-3", "figure-8-4", "figure-8-5"),
    "figure-4-10",
)
"""Tables and figures that can be reproduced."""


@click.command(cls=Command)
@click.option(
    "--table",
    "tables",
    multiple=True,
    metavar="T",
    help=f"Table to reproduce, repeatable (default: all): {', '.join(NAMES)}.",
)
@click.option(
    "--calibrate",
    is_flag=True,
    help="Fit the stage to half of the cells and predict the others, then swap "
    "(half an hour or more).",
)
@common
def main(tables, calibrate, out, seed, quiet):
    """Reproduce result tables of the thesis in simulation, with the printed gains."""
    del seed  # the simulated noise has its own seeds

    # JAX and its users are imported here, so that --help does not wait for them.
    def body(console):
        from ..report.summary_tables import reproduction_table
        from ..report.table_pictures import write_picture, write_rates
        from ..reproduction import reproduce
        from ..reproduction.rates import FIGURE, errors_by_rate, rates_as_csv
        from ..reproduction.summary import as_csv, summarise

        requested = tuple(dict.fromkeys(tables)) or NAMES
        for table in requested:
            if table not in NAMES:
                raise ValueError(
                    f"--table {table} is unknown; there are {', '.join(NAMES)}"
                )
        tabulated = [table for table in requested if table != FIGURE]
        cells = []
        with (
            results_folder(out, "reproduce") as folder,
            console.status("simulating") as status,
        ):
            for table in tabulated:
                status.update(f"simulating Table {table}")
                cells += reproduce(table)
            summary = summarise(cells)
            write_text(folder / "cells.csv", as_csv(cells))
            plain = {table: entry.model_dump() for table, entry in summary.items()}
            write_text(folder / "summary.json", json.dumps(plain, indent=2) + "\n")
            if cells:
                write_picture(cells, folder)
            if FIGURE in requested:  # printed as a curve: no cells to compare
                status.update("simulating Figure 4.10")
                errors = errors_by_rate()
                write_text(folder / f"{FIGURE}.csv", rates_as_csv(errors))
                write_rates(errors, folder)
        for table in tabulated:
            console.print(
                reproduction_table(
                    table, [c for c in cells if c.table == table], summary[table]
                )
            )
        console.print(f"results in {folder}", soft_wrap=True)

    def calibration(console):
        from ..report.calibrated_cells import (
            calibration_table,
            together_table,
            write_calibration,
        )
        from ..reproduction.calibration import EXPERIMENTS, calibrate
        from ..reproduction.calibration_report import (
            calibration_report,
            held_out_ratios,
        )

        if tables:
            raise ValueError("--calibrate has tables of its own; leave --table out")
        with results_folder(out, "calibrate") as folder:
            with Bar(console) as bar:
                fits = {n: calibrate(n, progress=bar) for n in EXPERIMENTS}
            plain = {n: calibration_report(n, both) for n, both in fits.items()}
            held_out = held_out_ratios(fits)
            text = json.dumps(plain | {"together": held_out}, indent=2)
            write_text(folder / "calibration.json", text + "\n")
            write_calibration(fits, plain, folder)
        for name, both in fits.items():
            console.print(calibration_table(name, both, plain[name]))
        console.print(together_table(held_out))
        console.print(f"results in {folder}", soft_wrap=True)

    run(quiet, calibration if calibrate else body)
