"""Hysteresis and creep from a slow record, with the dynamics of a saved model held."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

import piezojax as pj
from piezojax.catalog import mirror
from piezojax.cli.identify import main
from piezojax.core.about import About
from piezojax.core.error_bound import UNSEEN, ErrorBound
from piezojax.core.serial import read_about, save
from piezojax.identification.chain import structure
from piezojax.identification.estimators.free_runs import free_run
from piezojax.identification.held_dynamics import combined_bound, held_dynamics
from piezojax.identification.records.record import Record

FAST, SLOW = 1.0 / 20_000.0, 1.0 / 500.0
MODES = pj.dynamics.Modes([820.0, 2600.0], [0.02, 0.03], FAST, [0.2])
RESPONSE = pj.series(
    gain=pj.Affine(0.1),
    dynamics=MODES,
    whole_delay=pj.Delay(2),
    delay=pj.dynamics.FractionalDelay(5e-5, FAST, 1),
)
BOUND = ErrorBound(
    frequency=(10.0, 5000.0, 5001.0, 10_000.0),
    relative=(0.02, 0.05, UNSEEN, UNSEEN),
    excited=(True, True, False, False),
)
ABOUT = About(
    rate_Hz=1.0 / FAST,
    units={"input": "V", "output": "um"},
    error_bound=BOUND,
    standard_errors={"dynamics.frequency.0": 0.5, "gain.gain": 1e-4},
)


@cache
def held():
    return held_dynamics(RESPONSE, ABOUT, "model.json")


def test_the_dynamics_behind_the_gain_are_held():
    found = held()
    assert list(found.parts) == ["dynamics", "whole_delay", "delay"]
    assert found.gain == pytest.approx(0.1)
    assert found.standard_errors() == {"dynamics.frequency.0": 0.5}


def test_they_are_the_same_stage_at_another_rate():
    """An input held over the long samples: the outputs agree where both exist."""
    ratio = round(SLOW / FAST)
    slow = np.random.default_rng(1).standard_normal(60)
    fast = np.repeat(slow, ratio)
    outputs = []
    for input, dt in ((slow, SLOW), (fast, FAST)):
        parts = {"dynamics": held().at(dt)["dynamics"]}
        tail = pj.series(**parts)
        outputs.append(
            np.asarray(pj.simulate(tail, jnp.asarray(input), tail.init(0.0))[1])
        )
    np.testing.assert_allclose(outputs[0], outputs[1][ratio - 1 :: ratio], atol=1e-9)
    late = held().at(SLOW)["whole_delay"]
    assert float(late.delay) == pytest.approx(2 * FAST)


def test_a_fitted_chain_gives_its_linear_tail_with_unit_gain():
    chain = pj.series(
        hysteresis=pj.hysteresis.PrandtlIshlinskii((0.1,), (2.0,), (0.01,)),
        creep=pj.dynamics.ExponentialCreep((0.02,), (1.0,), FAST),
        dynamics=pj.dynamics.ARMA((0.5, 0.0), (1.0, 0.0, 0.0)),
        calibration=pj.Affine(1.0, 3.0),
    )
    found = held_dynamics(chain, ABOUT, "m.json")
    assert list(found.parts) == ["dynamics", "unit_gain"]
    assert float(found.parts["unit_gain"].gain) == pytest.approx(0.5)
    assert found.gain is None
    assert found.gain_notes(ladder()) == ([], [])
    with pytest.raises(ValueError, match="runs at 20000 Hz alone: resample the"):
        found.at(SLOW)


ALONE = pj.hysteresis.PrandtlIshlinskii((0.1,), (2.0,), (0.01,))


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (pj.series(hysteresis=ALONE), "has no linear dynamics behind its hysteresis"),
        (ALONE, "has no linear dynamics behind its hysteresis"),
        (pj.hardware.Saturation(-0.1, 0.1), "are not linear"),
        (mirror.stage(), "have several inputs"),
    ],
)
def test_models_without_linear_dynamics_are_refused(system, message):
    with pytest.raises(ValueError, match=message):
        held_dynamics(system, ABOUT, "m.json")


def test_a_model_must_not_have_dynamics_of_its_own():
    with pytest.raises(ValueError, match=r"come from model.json: leave lag out"):
        structure("coleman_hodgdon+lag", ladder(), held())
    shape = structure("coleman_hodgdon", ladder(), held())
    assert shape.system.names == (
        *("hysteresis", "dynamics", "whole_delay", "delay", "calibration"),
    )
    assert not any(path.startswith(("dyn", "del")) for path in shape.space.paths)


def test_a_gain_that_cannot_be_that_of_the_stage_is_an_alarm():
    record = ladder()
    alarms, notes = held().gain_notes(record)
    assert alarms == []
    assert "gain of model.json is 0.1 um/V, for small motions" in notes[0]
    nanometres = Record(record.inputs, 1e3 * record.outputs, SLOW, output_units="nm")
    assert held().gain_notes(nanometres)[0] == []
    wrong = Record(record.inputs, 1e3 * record.outputs, SLOW)
    assert "units, columns or stage differ" in held().gain_notes(wrong)[0][0]


def test_the_bound_is_that_of_both_records():
    slow = ErrorBound(
        frequency=(1.0, 20.0, 100.0, 250.0),
        relative=(0.3, 0.04, 0.1, UNSEEN),
        excited=(True, True, True, False),
    )
    found = combined_bound(slow, BOUND, FAST)
    assert found.at(1.0) == pytest.approx(0.3)
    assert found.at(50.0) >= 0.1
    # The best line of the slow record's last decade, times that of the response.
    assert found.at(5000.0) == pytest.approx(1.04 * 1.05 - 1.0)
    assert found.at(8000.0) == UNSEEN
    assert found.excited_at(3000.0)
    assert not found.excited_at(8000.0)
    alone = combined_bound(slow, None, FAST)
    assert alone.at(8000.0) >= UNSEEN
    assert not alone.excited_at(8000.0)
    unseen = slow.model_copy(update={"excited": (False,) * 4})
    assert combined_bound(unseen, BOUND, FAST) is None
    assert combined_bound(None, BOUND, FAST) is None


TRUE = pj.hysteresis.ColemanHodgdon(0.0036, 0.09, -0.03)


@cache
def ladder():
    """Return a slow record of steps over the range, of the stage of RESPONSE."""
    levels = [0, 25, 50, 75, 100, 75, 50, 25, 0, 30, 60, 90, 60, 30, 0, 45, 80, 20]
    input = np.repeat(np.array(levels, float), 25)
    stage = pj.series(hysteresis=TRUE, dynamics=held().at(SLOW)["dynamics"])
    clean = np.asarray(free_run(stage, jnp.asarray(input), 0.0))
    noise = 0.005 * np.random.default_rng(3).standard_normal(input.size)
    return Record(input, clean + noise, SLOW, source="slow.csv")


def test_two_commands_give_the_whole_plant(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(RESPONSE, tmp_path / "model.json", ABOUT)
    record = ladder()
    table = np.column_stack([record.input, record.output])
    head = "drive_V,displacement_um"
    np.savetxt("slow.csv", table, "%.9g", ",", header=head, comments="")
    line = (
        "slow.csv --rate 500 --dynamics model.json --model coleman_hodgdon --out found"
    )
    done = CliRunner().invoke(main, line.split())
    assert done.exit_code == 0, done.output
    assert "dynamics of model.json, held" in done.output
    assert "the plant runs at 20000 Hz; " in done.output
    plant = pj.load(tmp_path / "found" / "model.json")
    about = read_about(tmp_path / "found" / "model.json")
    hysteresis, modes, *_ = plant.parts
    assert float(hysteresis.b) == pytest.approx(0.09, rel=0.02)
    assert modes.dt == FAST
    assert [float(f) for f in modes.frequency] == [820.0, 2600.0]
    assert about.rate_Hz == pytest.approx(20_000.0)
    assert about.standard_errors["dynamics.frequency.0"] == 0.5
    assert about.error_bound is None or about.error_bound.at(4000.0) > 0.05
    refused = CliRunner().invoke(main, [*line.split()[:-4], "--model", "bouc_wen"])
    assert refused.exit_code == 1
    assert "the dynamics come from model.json: bouc_wen has its own" in refused.output
