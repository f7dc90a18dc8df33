"""Tables 5-3 and 5-5, against print and a loop from the equations."""

import csv
import io
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from oracles import published, signals
from oracles.loop import closed_loop, tracking_rms

from piezojax.reproduction import reproduce, summarise
from piezojax.reproduction.cell import Cell, window
from piezojax.reproduction.summary import as_csv
from piezojax.signals.waveforms import THESIS

COMPARED = ("5-3", "5-5")

COLUMNS = {"pid_smc": "smc", "inversion": "inversion", "dob": "dob"}
"""Kind of controller of the oracle by column of the tables."""

PRINTED = Path(__file__).parents[3] / "shared" / "tables" / "thesis_results.csv"


@pytest.fixture(scope="module")
def tables():
    return {name: reproduce(name) for name in COMPARED}


@pytest.fixture(scope="module")
def summary(tables):
    return summarise([cell for cells in tables.values() for cell in cells])


@pytest.fixture(scope="module")
def cell(tables):
    every = [cell for cells in tables.values() for cell in cells]
    return {(c.table, c.row, c.column): c for c in every}


@pytest.mark.slow
def test_every_cell_is_present(tables):
    for name, cells in tables.items():
        places = [(c.row, c.column) for c in cells]
        assert places == [(row, column) for row in THESIS for column in COLUMNS]
        assert {c.table for c in cells} == {name}
        assert {c.unit for c in cells} == {"um"}
        assert all(math.isfinite(c.sim) and c.sim > 0 for c in cells)


@pytest.mark.slow
def test_the_data_equal_the_printed_tables(cell):
    if not PRINTED.is_file():
        pytest.skip(f"{PRINTED} is not here; the numbers below are checked anyway")
    with PRINTED.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["table"] in COMPARED]
    printed = {
        (r["table"], r["row"], r["column"]): (float(r["paper"]), r["unit"])
        for r in rows
    }
    assert {place: (c.paper, c.unit) for place, c in cell.items()} == printed


@pytest.mark.parametrize(
    ("place", "paper"),
    [
        (("5-3", "SIN1", "pid_smc"), 0.027),
        (("5-3", "SIN1", "inversion"), 0.0055),
        (("5-3", "SIN50", "pid_smc"), 0.5988),
        (("5-3", "PWSW50", "dob"), 0.3628),
        (("5-5", "SIN1", "dob"), 0.0137),
        (("5-5", "SIN50", "inversion"), 0.0867),
    ],
)
@pytest.mark.slow
def test_a_few_printed_numbers(cell, place, paper):
    assert cell[place].paper == paper


def oracle_reference(name, samples):
    """Return ``samples`` samples and a repeat of the last one, as the loop assumes."""
    kind, frequency = re.fullmatch(r"([A-Z]+)(\d+)", name).groups()
    make = {
        "SIN": signals.sine,
        "PWSW": signals.piecewise_sine,
        "SW": signals.superposed_sine,
    }[kind]
    values = make(float(frequency), duration=samples / published.RATE)
    return np.append(values, values[-1])


# each column twice, each kind of reference, both tables; the shorter runs
@pytest.mark.parametrize(
    "place",
    [
        ("5-3", "SIN10", "pid_smc"),
        ("5-3", "PWSW30", "inversion"),
        ("5-3", "SIN50", "dob"),
        ("5-3", "SW50", "pid_smc"),
        ("5-5", "SIN30", "inversion"),
        ("5-5", "SW50", "dob"),
    ],
    ids="-".join,
)
@pytest.mark.slow
def test_cells_equal_a_loop_from_the_equations(cell, place):
    table, row, column = place
    reference = oracle_reference(row, round(2.0 * window(row) * published.RATE))
    kind = COLUMNS[column]
    run = closed_loop(
        kind,
        reference,
        published.plant_t2("trapezoid"),
        published.smc_gains(kind, table),
        limits=published.LIMITS,
        rate=published.RATE,
    )
    expected = tracking_rms(run["displacement"], reference)
    assert cell[place].sim == pytest.approx(expected, rel=0, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("SIN1", 1.0),
        ("SIN10", 1.0),
        ("SIN30", 1.0),
        ("SIN50", 1.0),
        ("PWSW10", 1.2),
        ("PWSW30", 16 / 15),
        ("PWSW50", 1.04),
        ("SW10", 2.0),
        ("SW30", 4 / 3),
        ("SW50", 1.2),
    ],
)
def test_errors_count_over_whole_periods_of_at_least_a_second(name, seconds):
    assert window(name) == pytest.approx(seconds, rel=1e-12)


# The bars


@pytest.mark.slow
def test_table_5_3_agrees_with_print(summary):
    assert summary["5-3"].geomean_ratio <= 1.25


@pytest.mark.slow
def test_both_tables_together_agree_with_print(cell):
    logs = [abs(math.log(c.sim / c.paper)) for c in cell.values()]
    assert len(logs) == 60
    assert math.exp(sum(logs) / len(logs)) <= 1.40


@pytest.mark.parametrize("row", ["SIN1", "SIN10", "PWSW10"])
@pytest.mark.parametrize("column", COLUMNS)
@pytest.mark.slow
def test_slow_cells_of_5_3_are_within_a_quarter(cell, row, column):
    found = cell["5-3", row, column]
    assert found.sim == pytest.approx(found.paper, rel=0.25)


# Written files


def cell_of(table, column, paper, sim):
    return Cell(table, "SIN1", column, "um", paper, sim)


def test_ratios_of_a_synthetic_table():
    cells = [
        cell_of("9-1", "pid", 1.0, 2.0),
        cell_of("9-1", "pid", 1.0, 0.5),
        cell_of("9-1", "dob", 4.0, 1.0),
        cell_of("9-2", "pid", 3.0, 3.0),
    ]
    found = summarise(cells)
    assert list(found) == ["9-1", "9-2"]
    assert found["9-1"].geomean_ratio == pytest.approx(2.0 ** (4 / 3))
    assert found["9-1"].worst_ratio == pytest.approx(4.0)
    assert found["9-1"].cells == 3
    assert found["9-1"].columns["pid"].geomean_ratio == pytest.approx(2.0)
    assert found["9-1"].columns["pid"].cells == 2
    assert found["9-1"].columns["dob"].worst_ratio == pytest.approx(4.0)
    assert found["9-2"].geomean_ratio == 1.0


@pytest.mark.slow
def test_summary_has_the_agreed_keys(summary, tables):
    plain = json.loads(
        json.dumps({name: entry.model_dump() for name, entry in summary.items()})
    )
    assert set(plain) == set(tables)
    for entry in plain.values():
        assert set(entry) == {"geomean_ratio", "worst_ratio", "cells", "columns"}
        assert entry["cells"] == 30
        assert set(entry["columns"]) == set(COLUMNS)
        for column in entry["columns"].values():
            assert {"geomean_ratio", "worst_ratio"} <= set(column)
            assert 1.0 <= column["geomean_ratio"] <= column["worst_ratio"]
            assert column["worst_ratio"] <= entry["worst_ratio"]


@pytest.mark.slow
def test_csv_has_the_agreed_header_and_enough_digits(tables):
    cells = tables["5-3"]
    lines = as_csv(cells).splitlines()
    assert lines[0] == "table,row,column,unit,paper,sim"
    rows = list(csv.DictReader(io.StringIO(as_csv(cells))))
    assert len(rows) == 30
    for row, made in zip(rows, cells, strict=True):
        assert (row["table"], row["row"], row["column"], row["unit"]) == (
            made.table,
            made.row,
            made.column,
            made.unit,
        )
        assert float(row["paper"]) == made.paper
        assert float(row["sim"]) == pytest.approx(made.sim, rel=1e-5)


@pytest.mark.parametrize("name", ["9-9", "", "5-4", "5_3"])
def test_unknown_table(name):
    message = f"table {name!r} is unknown; there are 3-6, 3-7, 4-5, 4-6"
    with pytest.raises(ValueError, match=re.escape(message)):
        reproduce(name)
