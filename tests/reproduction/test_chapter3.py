"""Tables 3-6 and 3-7: the printed cells, the simulated stage, and its errors."""

import csv
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import dynamics, hysteresis

from piezojax.catalog import p753
from piezojax.reproduction import TABLES, chapter3, reproduce, summarise
from piezojax.reproduction.cell import printed
from piezojax.signals import waveforms as signals

PRINTED = Path(__file__).parents[3] / "shared" / "tables" / "thesis_results.csv"
ROWS = (
    *("PWSW10", "PWSW50", "PWSW200", "PWSW400", "SW100", "SW400"),
    *("SIN200", "SIN300", "SIN400", "SIN500", "SIN600"),
)


def test_every_chapter_has_its_tables():
    assert list(TABLES) == [
        *("3-6", "3-7"),
        *("4-5", "4-6", "figure-4-5", "figure-4-7"),
        *("5-3", "5-5"),
        *("6-7", "6-8"),
        *("7-4", "figure-7-4"),
        *("8-2", "8-3", "figure-8-4", "figure-8-5"),
    ]


@pytest.mark.parametrize("table", chapter3.TABLES)
def test_the_printed_cells(table):
    cells = printed("ch3", table)
    assert list(cells) == [(r, c) for r in ROWS for c in chapter3.TABLES[table]]
    assert all(np.isnan(cell.sim) for cell in cells.values())
    if not PRINTED.is_file():
        pytest.skip(f"{PRINTED} is not here; the numbers below are checked anyway")
    with PRINTED.open(encoding="utf-8") as file:
        lines = [line for line in csv.DictReader(file) if line["table"] == table]
    assert {(c.row, c.column): (c.paper, c.unit) for c in cells.values()} == {
        (n["row"], n["column"]): (float(n["paper"]), n["unit"]) for n in lines
    }


@pytest.mark.parametrize(
    ("table", "row", "column", "paper"),
    [
        ("3-6", "PWSW10", "voros", 0.0946),
        ("3-6", "SIN600", "trapezoid", 1.0187),
        ("3-7", "SIN300", "quadratic", 0.0512),
    ],
)
def test_a_few_printed_numbers(table, row, column, paper):
    assert printed("ch3", table)[row, column].paper == paper


def test_the_stage_is_the_exact_hysteresis_with_unit_dc_gain():
    voltage = 35.0 * (1.0 - np.cos(np.linspace(0.0, 30.0, 500)))
    parameters = (0.0064, 0.1144, -0.0305)
    inner = hysteresis.exact(voltage, *parameters)
    moving = np.array([-0.07323, 0.1736, -0.09756])
    moving *= (1.0 - 1.6531 + 0.6758) / moving.sum()
    expected = dynamics.arma(inner, (1.6531, -0.6758), moving)
    found = chapter3._output(chapter3.simulated_stage(), jnp.asarray(voltage))
    np.testing.assert_allclose(found[1:], expected[:-1], rtol=0, atol=1e-10)
    assert found[0] == 0.0


@pytest.fixture(scope="module")
def cells():
    every = [cell for table in chapter3.TABLES for cell in reproduce(table)]
    return {(c.table, c.row, c.column): c for c in every}


@pytest.mark.slow
def test_no_error_is_below_the_sensor_noise(cells):
    assert len(cells) == 44
    assert all(cell.sim > 0.98 * p753.NOISE_RMS for cell in cells.values())


@pytest.mark.slow
def test_the_earlier_model_is_worse_as_printed(cells):
    for row in ROWS:
        assert cells["3-6", row, "voros"].sim > cells["3-6", row, "trapezoid"].sim
    errors = [cells["3-6", f"SIN{f}", "voros"].sim for f in (200, 300, 400, 500, 600)]
    assert errors == sorted(errors)
    assert errors[-1] > 5.0 * cells["3-6", "SIN600", "trapezoid"].sim


@pytest.mark.slow
def test_the_errors_of_the_trapezoid_are_those_of_the_noise(cells):
    for row in ROWS:
        assert cells["3-6", row, "trapezoid"].sim < 1.1 * p753.NOISE_RMS
        again = replace(cells["3-6", row, "trapezoid"], table="3-7")
        assert cells["3-7", row, "trapezoid"] == again


@pytest.mark.slow
def test_the_printed_errors_are_not_reproduced(cells):
    summary = summarise(list(cells.values()))
    for table, columns in chapter3.TABLES.items():
        assert set(summary[table].columns) == set(columns)
        assert summary[table].cells == 22
        assert summary[table].geomean_ratio > 5.0  # the hardware has further effects


def test_the_inputs_stay_in_the_drive_s_range():
    for name in ROWS:
        time = signals.time_grid(0.5, p753.RATE)
        voltage = signals.signal(name, time, chapter3.AMPLITUDE)
        lower, upper = p753.VOLTAGE_LIMITS
        assert lower <= float(voltage.min()) < float(voltage.max()) <= upper
