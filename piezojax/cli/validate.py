"""``python -m piezojax.validate MODEL RECORD... --out DIR``."""

from pathlib import Path

import click

from .command import (
    Command,
    common,
    exit_unsafe,
    print_loading,
    print_results,
    results_folder,
    run,
)
from .records import SampleRange, print_columns, record_columns
from .terminal import Bar


@click.command(cls=Command)
@click.argument("model", type=click.Path(path_type=Path))
@click.argument(
    "records",
    nargs=-1,
    required=True,
    type=click.Path(path_type=Path),
    metavar="RECORD...",
)
@record_columns
@click.option(
    "--estimate",
    type=SampleRange(),
    help="Samples from which the state before each record and the zero of its sensor "
    "are estimated (default: a fifth, or more until the input has covered its range).",
)
@common
def main(model, records, estimate, out, seed, quiet, **columns):
    """Judge a fitted MODEL on other RECORDs of its stage, and save it with the verdict.

    No parameter of the model changes. The file model.json in the results holds the
    alarms and an error bound that also covers these records; use this file in a study.
    """
    del seed  # nothing is random

    def body(console):
        print_loading(console)
        from ..core.serial import load, read_about
        from ..identification import read_record, validate
        from ..identification.residual_record import load_residual
        from ..report.model_validation import validation_page, write_validation
        from ..report.page import write_page

        system, about = load(model, accept_unsafe=True), read_about(model)
        residual = load_residual(model, about)
        loaded = [read_record(record, **columns) for record in records]
        print_columns(console, loaded)
        with Bar(console) as bar, results_folder(out, model.stem) as folder:
            bar.stage("judging the model")
            found = validate(system, about, loaded, estimate=estimate)
            bar.stage("drawing")
            pictures = write_validation(found, folder, residual)
            page = validation_page(found)
            write_page(page, folder, pictures)
        print_results(page, folder, console)
        exit_unsafe(page.alarms)

    run(quiet, body)
