"""``python -m piezojax.reproduce [--table T ... | --calibrate] --out DIR``."""

import json
from typing import Any

import click

from ..core.files import write_text
from .command import Command, common, print_results, results_folder, run
from .stopping import exit_interrupted
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
    help="Fit the stage to half of the table cells and predict the other half, then "
    "swap the halves (half an hour or more).",
)
@common
def main(tables, calibrate, out, seed, quiet):
    """Reproduce result tables of the thesis in simulation, with the printed gains."""
    del seed  # the simulated noise has its own seeds

    # JAX and its users are imported here, so that --help does not wait for them.
    def body(console):
        from ..report.page import Page, write_page
        from ..report.reproduction_tables import reproduction_table
        from ..report.table_pictures import write_picture, write_rates
        from ..reproduction import reproduce
        from ..reproduction.cell import title_of
        from ..reproduction.rates import FIGURE, errors_by_rate, rates_as_csv
        from ..reproduction.summary import as_csv, summarise

        requested = tuple(dict.fromkeys(tables)) or NAMES
        for table in requested:
            if table not in NAMES:
                raise ValueError(
                    f"--table {table} is unknown; there are {', '.join(NAMES)}"
                )
        cells = []

        def simulate(table, bar, folder):
            if table == FIGURE:  # printed as a curve: no cells to compare
                bar.stage("simulating Figure 4.10")
                errors = errors_by_rate()
                write_text(folder / f"{FIGURE}.csv", rates_as_csv(errors))
                write_rates(errors, folder)
                return
            bar.stage(f"simulating {title_of(table)}")
            cells.extend(reproduce(table))
            write_text(folder / "cells.csv", as_csv(cells))
            plain = {t: entry.model_dump() for t, entry in summarise(cells).items()}
            write_text(folder / "summary.json", json.dumps(plain, indent=2) + "\n")

        interrupted = False
        with Bar(console) as bar, results_folder(out, "reproduce") as folder:
            try:
                for table in sorted(requested, key=lambda table: table == FIGURE):
                    simulate(table, bar, folder)
            except KeyboardInterrupt:
                interrupted = True
                if not cells:
                    raise
            bar.finish()
            if cells:
                bar.stage("drawing")
                write_picture(cells, folder)
            parts: list[Any] = [
                reproduction_table(table, [c for c in cells if c.table == table], entry)
                for table, entry in summarise(cells).items()
            ]
            if interrupted:
                parts.append("interrupted: these are the tables finished so far")
            page = Page("tables of the thesis, printed and simulated", (), parts)
            write_page(page, folder)
        print_results(page, folder, console)
        if interrupted:
            exit_interrupted()

    def calibration(console):
        from ..report.calibrated_cells import (
            calibration_table,
            held_out_table,
            write_calibration,
        )
        from ..report.page import Page, write_page
        from ..reproduction.calibration import EXPERIMENTS, calibrate
        from ..reproduction.calibration_report import (
            calibration_report,
            held_out_ratios,
        )

        if tables:
            raise ValueError("--calibrate chooses its own tables; leave --table out")
        fits, plain = {}, {}
        with Bar(console) as bar, results_folder(out, "calibrate") as folder:
            for name in EXPERIMENTS:
                fits[name] = calibrate(name, progress=bar)
                plain[name] = calibration_report(name, fits[name])
                together = {"together": held_out_ratios(fits)}
                text = json.dumps(plain | together, indent=2)
                write_text(folder / "calibration.json", text + "\n")
            bar.finish()
            write_calibration(fits, plain, folder)
            parts = [
                *(
                    calibration_table(name, both, plain[name])
                    for name, both in fits.items()
                ),
                held_out_table(held_out_ratios(fits)),
            ]
            page = Page("stage calibrated on tables of the thesis", (), parts)
            write_page(page, folder)
        print_results(page, folder, console)

    run(quiet, calibration if calibrate else body)
