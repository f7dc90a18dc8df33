"""Figures of controllers beside the tuned one, against plain runs."""

import json

import equinox as eqx
import jax
import numpy as np
import pytest
import tomli_w

import piezojax as pj
from piezojax.analysis.stability import OperatingPoint, stability_report
from piezojax.catalog import p753_survey
from piezojax.core.feedback import Feedback, loop_inputs
from piezojax.core.progress import Silent
from piezojax.report.tuning_tables import beside_table
from piezojax.solve.clock import Clock
from piezojax.study import read
from piezojax.tuning.beside import FiguresBeside
from piezojax.tuning.data import make_data
from piezojax.tuning.evaluator import Evaluator
from piezojax.tuning.held_out import held_out

RULE = {"catalog": "p753_feedforward_simc_pi"}
BESIDE = {
    "PI by rule": {"controller": RULE},
    "slower PI": {
        "controller": RULE,
        "gains": {"feedback.proportional": 1.0, "feedback.integral": 800.0},
    },
    "PI of the wrong sign": {
        "controller": RULE,
        "gains": {"feedback.proportional": -100.0, "feedback.integral": -1e5},
    },
}
STUDY = {
    "title": "integral action on the P-753",
    "rate": 20000.0,
    "seed": 5,
    "plant": {"catalog": "p753_stage"},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.001},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 200.0, "dt": 5e-5},
    "references": {
        "tune": ["SIN50"],
        "unseen": ["SIN20"],
        "amplitude": 2.0,
        "duration": 0.05,
        "settle": 0.02,
    },
    "parameters": {"controller.integral": {"lower": 20.0, "upper": 2e3}},
    "ensemble": {"spread": {"gain": 0.2}, "holdout": 3},
    "beside": BESIDE,
}


def written(folder, **changes):
    path = folder / "study.toml"
    data = {k: v for k, v in (STUDY | changes).items() if v is not None}
    path.write_text(tomli_w.dumps(data), encoding="utf-8")
    return path


def found_of(path):
    case = read(path)
    data = make_data(case)
    own = held_out(case, Evaluator(Clock(), case), data)
    with FiguresBeside(case) as beside:
        beside.begin(data, own)
        return case, data, beside.all(own, Silent())


@pytest.fixture(scope="module")
def perturbed(tmp_path_factory):
    return found_of(written(tmp_path_factory.mktemp("beside")))


def error_of(loop, data):
    """Return the geometric mean of the held-out RMS errors (um), from samples."""
    logs, holdout = [], data.holdout
    run = eqx.filter_jit(
        lambda r, n, d: pj.simulate(loop, loop_inputs(r, n, d), loop.init(r[0]))[1]
    )
    for i, reference in enumerate(holdout.references):
        disturbance = None if holdout.disturbance is None else holdout.disturbance[i, 0]
        sample = run(reference, holdout.noise[i, 0], disturbance)
        error = np.asarray(sample.displacement - sample.reference)[400:]
        logs.append(np.log(np.sqrt(np.mean(error**2))))
    return np.exp(np.mean(logs))


def test_the_figures_equal_those_of_runs_on_each_plant(perturbed):
    case, data, found = perturbed
    assert list(found) == [*BESIDE, "before", "tuned"]
    assert found["before"] == found["tuned"]  # equal gains
    stages = case.ensemble.stages("holdout")
    plants = [jax.tree.map(lambda x, i=i: x[i], stages).plant for i in range(3)]
    nominal = case.loop.plant

    def loop_on(plant):
        controller = p753_survey.feedforward_simc_pi()
        return Feedback(controller, plant, case.loop.actuator, case.loop.sensor)

    one = found["PI by rule"]
    assert one.nominal_rms_um == pytest.approx(error_of(loop_on(nominal), data))
    errors = [error_of(loop_on(plant), data) for plant in plants]
    assert one.geomean_rms_um == pytest.approx(np.median(errors))
    assert one.worst_rms_um == pytest.approx(np.max(errors))
    assert (one.plants, one.unstable) == (3, 0)
    peaks = [
        stability_report(loop_on(plant), OperatingPoint(4.0, branch)).sensitivity_peak
        for plant in plants
        for branch in ("ascending", "descending")
    ]
    assert one.sensitivity_peak == pytest.approx(max(peaks), rel=5e-3)


def test_gains_are_those_of_the_study(perturbed):
    found = perturbed[2]
    assert found["slower PI"].nominal_rms_um > 2.0 * found["PI by rule"].nominal_rms_um


def test_a_saturated_controller_has_no_error(perturbed):
    wrong = perturbed[2]["PI of the wrong sign"]
    errors = wrong.nominal_rms_um, wrong.geomean_rms_um, wrong.worst_rms_um
    assert (*errors, wrong.unstable) == (None, None, None, 3)


def test_without_an_ensemble_the_figures_are_of_the_nominal_plant(tmp_path):
    _, _, found = found_of(written(tmp_path, ensemble=None))
    assert found["PI by rule"].plants == 0
    assert found["PI by rule"].geomean_rms_um is None
    assert found["PI by rule"].sensitivity_peak > 1.0


def test_a_study_without_beside_has_no_figures(tmp_path):
    assert found_of(written(tmp_path, beside={}))[2] == {}


def test_a_tuned_study_saves_and_prints_the_figures(tmp_path):
    path = written(
        tmp_path,
        ensemble=None,
        optimiser={"starts": 1, "candidates": 0, "steps": 2},
        constraints={"sensitivity_peak": "off", "delay_margin": "off"},
    )
    result = pj.tune(path).result
    assert set(result.beside) == {*BESIDE, "before", "tuned"}
    held_out = [
        *result.holdout.per_reference_rms_um.values(),
        *result.unseen.per_reference_rms_um.values(),
    ]
    tuned = result.beside["tuned"]
    assert tuned.nominal_rms_um == pytest.approx(np.exp(np.mean(np.log(held_out))))
    assert tuned.sensitivity_peak is None
    assert json.loads(result.model_dump_json())["beside"]["tuned"]
    (names,) = (list(c.cells) for c in beside_table(result).columns[:1])
    assert names == list(result.beside)
    turned = result.model_copy(update={"units": {"Rx": "urad"}})
    assert "on the hold-out, nrad: " in str(beside_table(turned).title)


def test_gains_of_an_earlier_run_are_read_from_their_file(tmp_path):
    pj.save(p753_survey.feedforward_simc_pi(), tmp_path / "gains.toml")
    beside = {
        "now": {"controller": {"file": "gains.toml"}},
        "rule": BESIDE["slower PI"],
    }
    beside["now"]["gains"] = beside["rule"]["gains"]
    case = read(written(tmp_path, beside=beside))
    assert eqx.tree_equal(case.beside["now"], case.beside["rule"])


PID_OF_CATALOG = {"controller": {"catalog": "p753_pid"}}


@pytest.mark.parametrize(
    ("beside", "message"),
    [
        ({"controller": {"catalog": "p753_no"}}, r"beside.x.controller.*p753_no"),
        ({"controller": {"catalog": "p558_pid"}}, "beside.x"),
        ({"controller": {"file": "none.toml"}}, "beside.x.controller.file: .*none"),
        ({"gains": {}}, "beside.x.controller"),
        (
            PID_OF_CATALOG | {"gains": {"proportionl": 1.0}},
            "beside.x.gains: .*proportionl",
        ),
        (
            PID_OF_CATALOG | {"gains": {"derivative_filter": -1.0}},
            "beside.x.gains.derivative_filter",
        ),
        (
            PID_OF_CATALOG | {"gains": {"proportional": "fast"}},
            "beside.x.gains.proportional",
        ),
    ],
)
def test_bad_controllers_beside_are_refused(tmp_path, beside, message):
    with pytest.raises(ValueError, match=message):
        read(written(tmp_path, beside={"x": beside}))


@pytest.mark.parametrize("name", ["before", "tuned"])
def test_names_of_the_own_loops_are_refused(tmp_path, name):
    with pytest.raises(ValueError, match=f"beside: {name} is the name of a loop of"):
        read(written(tmp_path, beside={name: PID_OF_CATALOG}))
