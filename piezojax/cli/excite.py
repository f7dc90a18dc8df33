"""``python -m piezojax.excite --lower V --upper V --rate HZ``: voltages to record."""

import click

from .command import Command, common, print_results, results_folder, run

RECORD = "record.csv"
"""File name of the voltages of all parts, one after another."""


@click.command(cls=Command)
@click.option("--lower", type=float, required=True, help="Lower limit, V.")
@click.option("--upper", type=float, required=True, help="Upper limit, V.")
@click.option("--rate", type=float, required=True, help="Rate of the generator, Hz.")
@click.option("--slew", type=float, help="Largest slew rate of the amplifier, V/s.")
@click.option(
    "--slowest",
    type=float,
    default=5.0,
    show_default=True,
    help="Frequency of the cycles over the whole range, Hz.",
)
@click.option(
    "--highest",
    type=float,
    help="Highest frequency of the multisine, Hz (default: 0.4 of the rate).",
)
@click.option(
    "--hold",
    type=float,
    default=0.25,
    show_default=True,
    help="Time for which a level is held, s; slower creep stays unknown.",
)
@click.option(
    "--points",
    type=click.IntRange(min=1),
    help="Size of the generator's buffer: write a file for each part, with at most "
    "this number of points, instead of one record.",
)
@common
def main(points, out, seed, quiet, **limits):
    """Write voltages that excite the hysteresis, creep and dynamics of a stage.

    Apply them to the stage, and record voltage and displacement. The file record.csv
    begins with a rest and contains all parts twice: identify fits the first half of the
    record and validates on the second. --points writes each part once, to its own file,
    at a lower rate or with a shorter multisine if needed; an NV200 has 1024 points at a
    --rate of 20000. Record each part, and give all records to identify together.
    """

    def body(console):
        from ..core.files import write_text
        from ..report.excitation_pictures import excitation_page, write_excitation
        from ..report.page import write_page
        from ..signals.excitation import Generator, Part, buffered, excitation

        known = {name: value for name, value in limits.items() if value is not None}
        generator = Generator(**known)
        if points is None:
            parts, whole = excitation(generator, seed or 0)
            files = {RECORD: Part("record", whole, generator.rate, "")}
        else:
            parts = buffered(generator, points, seed or 0)
            files = {f"{part.name}.csv": part for part in parts}
        with results_folder(out, "excitation") as folder:
            for name, part in files.items():
                write_text(folder / name, csv_of(part))
            pictures = write_excitation(parts, folder)
            page = excitation_page(parts, files)
            write_page(page, folder, pictures)
        print_results(page, folder, console)

    run(quiet, body)


def csv_of(part) -> str:
    """Return the times and voltages of a part as CSV."""
    rows = (f"{k / part.rate:.9g},{u:.6f}" for k, u in enumerate(part.voltages))
    return "\n".join(["time_s,voltage_V", *rows]) + "\n"
