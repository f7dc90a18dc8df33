"""Tables 4-5 and 4-6 and the steps: printed cells, figures, and bars."""

import csv
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from oracles import signals
from oracles.loop import closed_loop
from oracles.published import HYSTERESIS, LIMITS, unit_dc

from piezojax.reproduction import chapter4, reproduce, summarise
from piezojax.reproduction.cell import printed
from piezojax.signals.waveforms import THESIS

PRINTED = Path(__file__).parents[3] / "shared" / "tables" / "thesis_results.csv"
FIGURES = ("figure-4-5", "figure-4-7")


@pytest.mark.parametrize("table", ["4-5", "4-6"])
def test_the_printed_cells(table):
    cells = printed("ch4", table)
    columns = ("traditional", "model_reference", "continuous")
    assert list(cells) == [(row, column) for row in THESIS for column in columns]
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
        ("4-5", "SIN1", "traditional", 0.0117),
        ("4-5", "SIN50", "model_reference", 0.2315),
        ("4-6", "PWSW50", "continuous", 2.0464),
        ("figure-4-5", "amplitude", "bang_bang", 4.0),
        ("figure-4-7", "overshoot", "model_reference", 5.2),
        ("figure-4-7", "settling", "reference_model", 5.7),
    ],
)
def test_a_few_printed_numbers(table, row, column, paper):
    assert printed("ch4", table)[row, column].paper == paper


# Figures


def test_figures_of_a_step_equal_the_closed_form():
    rate, w, zeta = 50_000.0, 1_000.0, 0.5
    time = np.arange(2_000) / rate
    ratio = np.sqrt(1.0 - zeta**2)
    wave = np.cos(ratio * w * time) + zeta / ratio * np.sin(ratio * w * time)
    found = chapter4.step_figures(
        chapter4.STEP * (1.0 - np.exp(-zeta * w * time) * wave), rate
    )
    assert found.overshoot == pytest.approx(
        100.0 * np.exp(-np.pi * zeta / ratio), abs=0.01
    )
    reference = scipy.signal.step(([w**2], [1.0, 2 * zeta * w, w**2]), T=time)[1]
    last = np.flatnonzero(np.abs(reference - 1.0) > 0.02)[-1]
    assert found.settling == pytest.approx(1e3 * (last + 1) / rate, abs=0.021)


def test_a_response_outside_the_band_never_settles():
    found = chapter4.step_figures(np.linspace(0.0, 4.8, 100), 1e3)
    assert found.settling == np.inf
    assert found.overshoot == pytest.approx(-4.0)
    assert chapter4.step_figures(np.full(9, 5.05), 1e3).settling == 0.0


def test_chatter_is_computed_over_the_second_half():
    found = chapter4.chatter([90.0, -90.0, 3.0, 7.0, 4.0, 3.0])
    assert found == (4.0, 5.0)


# The bars


@pytest.fixture(scope="module")
def steps():
    cells = [cell for table in FIGURES for cell in reproduce(table)]
    return {(cell.row, cell.column): cell for cell in cells}


def test_every_number_of_the_figures_is_present(steps):
    assert list(steps) == [key for table in FIGURES for key in printed("ch4", table)]


@pytest.mark.parametrize("row", ["overshoot", "settling"])
@pytest.mark.parametrize("column", ["reference_model", "model_reference"])
def test_step_at_20_khz_is_within_a_fifth_of_print(steps, row, column):
    assert steps[row, column].ratio == pytest.approx(1.0, abs=0.2)


def test_chatter_amplitude_is_within_a_tenth_of_print(steps):
    assert steps["amplitude", "bang_bang"].ratio == pytest.approx(1.0, abs=0.1)
    assert steps["centre", "bang_bang"].ratio == pytest.approx(1.0, abs=0.1)


@pytest.fixture(scope="module")
def tables():
    return {table: reproduce(table) for table in ("4-5", "4-6")}


@pytest.mark.slow
def test_model_reference_agrees_with_print(tables):
    summary = summarise([cell for cells in tables.values() for cell in cells])
    assert summary["4-5"].columns["model_reference"].geomean_ratio <= 1.25
    assert summary["4-6"].columns["model_reference"].geomean_ratio <= 1.40
    assert summary["4-5"].columns["continuous"].geomean_ratio <= 1.50


@pytest.mark.slow
def test_every_cell_with_printed_gains_is_present(tables):
    for table, cells in tables.items():
        columns = chapter4.COLUMNS[table]
        places = [(cell.row, cell.column) for cell in cells]
        assert places == [(row, column) for row in THESIS for column in columns]
        assert all(np.isfinite(cell.sim) and cell.sim > 0.0 for cell in cells)
    assert "traditional" not in chapter4.COLUMNS["4-6"]


@pytest.mark.slow
def test_a_cell_equals_a_loop_from_the_equations(tables):
    poles = (1.6531, -0.6758)
    plant = {
        "hysteresis": HYSTERESIS,
        "step": "trapezoid",
        "p": poles,
        "g": unit_dc(poles, (-0.07323, 0.1736, -0.09756)),
    }
    gains = {
        **{"P": 1.0, "I": 12_000.0, "D": 2e-5, "m": (0.99,), "Q": 1.0, "R": 0.001},
        **{"alpha": 0.1, "beta": 1e-4, "frequency": 3_000.0, "damping": 0.25},
        "model_a": (1.6092, -0.6248),
        "model_b": (0.000778, -0.00041, 0.00134),
    }
    reference = signals.sine(50.0, duration=2.0)
    reference = np.append(reference, reference[-1])
    output = closed_loop("model reference", reference, plant, gains, limits=LIMITS)
    matrices = map(np.array, ([[0, 1], [-9e6, -1.5e3]], [[0], [9e6]], [[1, 0]], [[0]]))
    held = scipy.signal.cont2discrete(tuple(matrices), 5e-5, method="zoh")
    desired = scipy.signal.dlsim(held, reference)[1][:-1, 0]
    error = (output["displacement"] - desired)[20_000:]
    found = {(cell.row, cell.column): cell.sim for cell in tables["4-5"]}
    assert found["SIN50", "model_reference"] == pytest.approx(
        np.sqrt(np.mean(error**2)), rel=0, abs=1e-6
    )
