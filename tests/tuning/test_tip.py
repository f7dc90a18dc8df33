"""Error of the tip of a stage whose sensor may lag the tip."""

import dataclasses
import re

import numpy as np
import pytest
from stand_ins import fit_of

from piezojax import simulate
from piezojax.core.feedback import loop_inputs
from piezojax.dynamics import FirstOrderLag, Modes
from piezojax.dynamics.lags import before_lag, lags_of
from piezojax.hysteresis import ColemanHodgdon
from piezojax.identification.records.record import Record
from piezojax.study import Study, build
from piezojax.tuning.data import make_data
from piezojax.tuning.tip import tip_note

DT, LAG = 5e-5, 1e-3
STUDY = {
    "title": "a PID on a stage with a slow sensor",
    "rate": 1.0 / DT,
    "seed": 4,
    "plant": {"type": "FirstOrderLag", "time_constant": LAG, "dt": DT},
    "actuator": {"lower": -100.0, "upper": 100.0},
    "sensor": {"noise_rms": 1e-3},
    "controller": {"type": "PID", "proportional": 2.0, "integral": 4e3, "dt": DT},
    "references": {"tune": ["SIN50"], "duration": 0.06, "settle": 0.02},
    "parameters": {"controller.integral": {"lower": 30.0, "upper": 1e4}},
}


@pytest.fixture(scope="module")
def case():
    return build(Study.model_validate(STUDY), "small.toml")


def fitted(case, residual):
    """Return ``case`` as if its plant were fitted with this ``residual`` (um)."""
    moved = 10.0 * np.sin(np.arange(800.0) / 20.0)
    record = Record(moved, moved + residual, DT)
    return dataclasses.replace(case, fit=fit_of(case.loop.plant, record, moved))


def test_the_input_of_a_lag_is_recovered_from_its_output():
    wanted = np.random.default_rng(1).standard_normal(300)
    lag = FirstOrderLag(LAG, DT)
    output = np.asarray(simulate(lag, wanted)[1])
    found = before_lag(output, LAG, DT)
    # The first output is that at rest before the record.
    np.testing.assert_allclose(found, wanted[1:], rtol=0.0, atol=1e-10)


def test_all_lags_of_a_plant_are_found():
    modes = Modes([800.0], [0.02], DT, time_constant=[2e-3, 3e-4])
    plant = ColemanHodgdon(0.1, 0.15, -0.01) >> FirstOrderLag(LAG, DT) >> modes
    assert lags_of(plant) == pytest.approx([LAG, 2e-3, 3e-4])
    assert lags_of(ColemanHodgdon(0.1, 0.15, -0.01)) == []


def test_the_note_has_the_error_of_the_input_of_the_lag(case):
    """The tip is the input of the lag: here the voltage plus the residual."""
    case = fitted(case, 0.02 * np.sin(np.arange(800.0)))
    data, start = make_data(case), 400
    note = tip_note(case, case.loop, data, start)
    signals, worst = data.holdout, []
    for draw in range(2):
        inputs = loop_inputs(
            signals.references[0], signals.noise[0, draw], signals.disturbance[0, draw]
        )
        log = simulate(case.loop, inputs, case.loop.init(signals.references[0, 0]))[1]
        # The voltage of a sample acts until the next one.
        moved = np.append(0.0, np.asarray(signals.disturbance[0, draw])[:-1])
        error = (np.asarray(log.voltage) + moved - signals.references[0])[start:-1]
        reading = np.asarray(log.displacement - signals.references[0])[start:-1]
        worst.append([np.sqrt(np.mean(e**2)) for e in (error, reading)])
    of_tip, of_reading = (1e3 * value for value in np.max(worst, axis=0))
    told = [float(x) for x in re.findall(r"([\d.]+) (?:ms|nm)", note)]
    assert told == pytest.approx([1e3 * LAG, of_tip, of_reading], rel=2e-3)
    assert of_tip > 2.0 * of_reading


def test_there_is_no_note_without_a_fit_or_a_lag(case):
    assert tip_note(case, case.loop, make_data(case), 400) is None
    still = fitted(case, np.zeros(800))
    faster = dataclasses.replace(
        still,
        loop=dataclasses.replace(still.loop, plant=FirstOrderLag(0.5 * DT, DT)),
    )
    assert tip_note(faster, faster.loop, make_data(faster), 400) is None
