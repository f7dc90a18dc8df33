"""Resonances in 60 simulated records: estimated and true frequency and damping.

    python tests/benchmarks/resonance.py [--all] [--start] [--records 0:60] [--json F]

Each record is fitted with the default model of ``identify``; ``--all`` lets
``identify_all`` choose among the chains of a Coleman-Hodgdon loop and linear models,
``--start`` only looks for the resonance, without a fit. A record counts if the
frequency is within 1 % and the damping within 20 %. The stage is that of
``tests/oracles/resonant_records.py`` and shares no code with piezojax.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import resonant_records

from piezojax import Record, identify
from piezojax.core.recipe import Resonance
from piezojax.core.system import Series
from piezojax.dynamics import ARMA, Mode, Modes
from piezojax.identification import identify_all
from piezojax.identification.chain import dynamics_of, training_record

DT = 1.0 / resonant_records.RATE
AMONG = ["shaped_coleman_hodgdon", "prandtl_ishlinskii"]


def resonances(system):
    """Return the resonances of a fitted model."""
    if isinstance(system, Series):
        return [mode for part in system.parts for mode in resonances(part)]
    if isinstance(system, Mode):
        return [Resonance(float(system.frequency), float(system.damping))]
    if isinstance(system, Modes):
        pairs = zip(system.frequency, system.damping, strict=True)
        return [Resonance(float(f), float(d)) for f, d in pairs]
    if isinstance(system, ARMA):
        poles = system.poles().astype(complex)
        rates = np.log(poles[(poles.imag > 1e-9)]) / DT
        return [
            Resonance(float(abs(r)) / (2 * np.pi), float(-r.real / abs(r)))
            for r in rates
        ]
    return []


def fitted(case, how):
    """Return the name of the model and the resonance nearest to that of the case."""
    record = Record(*resonant_records.measured(case), DT, source=f"case {case.seed}")
    if how == "start":
        half = training_record([record], slice(0, record.samples // 2))
        name, found = "start", dynamics_of(half).modes
    elif how == "all":
        fit = identify_all(record, hysteresis=AMONG).best
        name, found = fit.report.model, resonances(fit.system)
    else:
        fit = identify(record)
        name, found = fit.report.model, resonances(fit.system)
    nearest = min(
        found, key=lambda m: abs(np.log(m.frequency / case.frequency)), default=None
    )
    return name, nearest


def main():
    """Run the records and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--all", dest="how", action="store_const", const="all")
    how.add_argument("--start", dest="how", action="store_const", const="start")
    parser.add_argument("--records", default="0:60", help="first:stop of the 60")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    first, stop = map(int, arguments.records.split(":"))
    console, rows = Console(), []
    for case in resonant_records.grid()[first:stop]:
        name, found = fitted(case, arguments.how)
        close = found is not None and (
            abs(found.frequency / case.frequency - 1.0) <= 0.01
            and abs(found.damping / case.damping - 1.0) <= 0.2
        )
        measured = found._asdict() if found else None
        rows.append(
            {**case._asdict(), "model": name, "found": measured, "within": close}
        )
        console.print(
            f"{case.seed}: {'within' if close else 'outside'}", highlight=False
        )
    table = Table(title=f"{sum(r['within'] for r in rows)} of {len(rows)} within")
    for column in ("record", "lag ms", "noise nm", "Hz", "found", "%", "found", ""):
        table.add_column(column, justify="right")
    for row in rows:
        found = row["found"] or {"frequency": np.nan, "damping": np.nan}
        table.add_row(
            f"{row['seed']} {row['excitation']}, {row['hysteresis']}",
            f"{1e3 * row['lag']:g}",
            f"{1e3 * row['noise']:g}",
            f"{row['frequency']:g}",
            f"{found['frequency']:.5g}",
            f"{100 * row['damping']:g}",
            f"{100 * found['damping']:.3g}",
            "" if row["within"] else "outside",
        )
    console.print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
