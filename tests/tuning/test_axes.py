"""Tuning on a stage with several axes: traces, coupling, ensembles of plants."""

import copy
import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w

import piezojax as pj
from piezojax.catalog import PLANTS, p558_stage
from piezojax.core.axes import packed
from piezojax.study import load, read, shipped
from piezojax.tuning.traces import traces_of

STUDY = {
    "title": "PID on three axes",
    "rate": 500.0,
    "axes": {"names": ["Z", "Rx", "Ry"], "units": ["um", "urad", "urad"]},
    "plant": {"catalog": "p558"},
    "actuator": {"lower": [-60.0, -300.0, -300.0], "upper": [60.0, 300.0, 300.0]},
    "sensor": {"noise_rms": [0.0008, 0.013, 0.013]},
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "controller": {"catalog": "p558_pid"},
    "references": {
        "tune": ["Z:SIN5", "Z:SIN5 Rx:SIN10"],
        "unseen": ["Ry:SIN5"],
        "amplitude": [5.0, 4.0, 3.0],
        "duration": 0.4,
        "settle": 0.2,
    },
    "parameters": {
        "controller.Z.integral": {"lower": 10.0, "upper": 500.0, "scale": "log"},
        "controller.Rx.integral": {"lower": 10.0, "upper": 500.0, "scale": "log"},
    },
    "ensemble": {"spread": {"gain": 0.2, "coupling": 0.5}, "tune": 2, "holdout": 5},
    "optimiser": {"starts": 1, "candidates": 0, "steps": 8},
}


def changed(**tables):
    study = copy.deepcopy(STUDY)
    for key, value in tables.items():
        table, _, name = key.partition("__")
        if name:
            study[table][name] = value
        else:
            study[table] = value
    return study


def written(folder, study):
    path = folder / "study.toml"
    path.write_text(tomli_w.dumps(study), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    return pj.tune(written(tmp_path_factory.mktemp("axes"), STUDY))


def test_each_axis_with_each_reference_is_a_trace(tmp_path):
    found = traces_of(load(written(tmp_path, STUDY)))
    assert [trace.name for trace in found] == [
        "Z:SIN5", "Z:SIN5 (Rx)", "Z:SIN5 (Ry)",
        "Z:SIN5 Rx:SIN10 (Z)", "Z:SIN5 Rx:SIN10 (Rx)", "Z:SIN5 Rx:SIN10 (Ry)",
        "Ry:SIN5 (Z)", "Ry:SIN5 (Rx)", "Ry:SIN5",
    ]  # fmt: skip
    driven = [True, False, False, True, True, False, False, False, True]
    assert [trace.driven for trace in found] == driven
    assert [trace.unit for trace in found[:3]] == ["um", "urad", "urad"]


def test_driven_axes_are_evaluated_separately(outcome):
    result = outcome.result
    driven = ["Z:SIN5", "Z:SIN5 Rx:SIN10 (Z)", "Z:SIN5 Rx:SIN10 (Rx)"]
    assert list(result.holdout.per_reference_rms_um) == driven
    assert list(result.unseen.per_reference_rms_um) == ["Ry:SIN5"]
    assert len(result.coupling.per_reference_rms_um) == 5
    assert result.units["Z:SIN5 Rx:SIN10 (Rx)"] == "urad"
    assert result.holdout.geomean_rms_um < 0.8 * result.holdout_before.geomean_rms_um
    # An axis that is neither tuned nor driven only has noise.
    assert result.coupling.worst_rms_um < 0.2


def test_figures_equal_those_of_a_run(outcome):
    """Compare the error of a trace with a plain run of the tuned loop."""
    case, signals = outcome.case, outcome.holdout
    loop, reference = outcome.after, signals.references[1]
    inputs = pj.loop_inputs(reference, signals.noise[1, 0])
    log = packed(pj.simulate(loop, inputs, loop.init(reference[0]))[1])
    start = round(case.study.references.settle * case.study.rate)
    miss = np.asarray(log.displacement - log.reference)[start:]
    found = outcome.result.holdout.per_reference_rms_um
    for axis, name in enumerate(("Z", "Rx")):
        rms = float(np.sqrt(np.mean(miss[:, axis] ** 2)))
        assert found[f"Z:SIN5 Rx:SIN10 ({name})"] == pytest.approx(rms, rel=1e-9)


def rests(outcome, plant):
    """Return whether a small motion of the tuned loop on ``plant`` dies out."""
    after, place = outcome.after, outcome.case.margin_reference
    loop = pj.Feedback(after.controller, plant, after.actuator, after.sensor)
    inputs = pj.loop_inputs(jnp.tile(jnp.asarray(place), (12_000, 1)))
    state = loop.init(jnp.asarray(place))
    pushed = jax.tree.map(lambda x: x + 1e-6, state.displacement)
    log = packed(pj.simulate(loop, inputs, state._replace(displacement=pushed))[1])
    return np.ptp(np.asarray(log.displacement)[-1000:], axis=0).max() < 1e-9


def test_perturbed_plants_are_evaluated_separately(outcome):
    """Compare median and worst factor with runs of both loops on each plant."""
    found = outcome.result.perturbed
    plants = outcome.case.ensemble.stages("holdout").plant
    each = [jax.tree.map(lambda x, i=i: x[i], plants) for i in range(5)]
    # The runs are too short to show an oscillation that grows slowly.
    stable = [rests(outcome, plant) for plant in each]
    unstable = stable.count(False)
    assert 0 < unstable < 5
    assert (found.plants, found.unstable_before, found.unstable) == (5, 0, unstable)
    signals = outcome.holdout

    @eqx.filter_jit
    def log_error(loop, plant, reference, noise):
        other = pj.Feedback(loop.controller, plant, loop.actuator, loop.sensor)
        inputs = pj.loop_inputs(reference, noise)
        log = packed(pj.simulate(other, inputs, other.init(reference[0]))[1])
        miss = (log.displacement - log.reference)[100:]
        return 0.5 * jnp.log(jnp.mean(miss**2, axis=0))

    factors = []
    for plant in (plant for plant, kept in zip(each, stable, strict=True) if kept):
        gained = [
            log_error(
                outcome.before, plant, signals.references[run], signals.noise[run, 0]
            )
            - log_error(
                outcome.after, plant, signals.references[run], signals.noise[run, 0]
            )
            for run in range(3)
        ]
        driven = [
            gained[trace.run][trace.axis]
            for trace in traces_of(outcome.case.study)
            if trace.driven
        ]
        factors.append(float(jnp.exp(jnp.mean(jnp.stack(driven)))))
    assert found.median_better == pytest.approx(np.median(factors), rel=1e-9)
    assert found.worst_better == pytest.approx(min(factors), rel=1e-9)


def test_gains_and_result_are_saved_and_loaded(outcome, tmp_path):
    pj.save(outcome.controller, tmp_path / "gains.toml")
    assert jax.tree.all(
        jax.tree.map(
            jnp.array_equal, pj.load(tmp_path / "gains.toml"), outcome.controller
        )
    )
    (tmp_path / "result.json").write_text(outcome.result.model_dump_json())
    assert pj.load_result(tmp_path) == outcome.result


def test_deviations_change_the_named_property():
    tenth = jnp.full(3, 0.1)
    ones = (jnp.asarray(1.0),) * 3

    def at_rest(**deviations):
        stage = PLANTS["p558"](**deviations).parts[1]
        return np.array(stage.step(stage.init(ones), ones)[1])

    nominal = at_rest()
    np.testing.assert_allclose(at_rest(gain=tenth), 1.1 * nominal, rtol=1e-12)
    np.testing.assert_allclose(at_rest(speed=tenth), nominal, rtol=1e-12)
    assert np.abs(at_rest(coupling=tenth) - nominal).max() > 1e-4


def test_draws_depend_on_the_seed_and_the_part(tmp_path):
    path = written(tmp_path, STUDY)
    first, again, other = (read(path, seed).ensemble for seed in (1, 1, 2))

    def gains(ensemble, part):
        return np.asarray(ensemble.stages(part).plant.parts[1].parts[0].B[0])

    np.testing.assert_array_equal(gains(first, "holdout"), gains(again, "holdout"))
    assert not np.isin(gains(first, "tune"), gains(first, "holdout")).any()
    assert not np.isin(gains(other, "tune"), gains(first, "tune")).any()
    nominal = float(p558_stage.plant().parts[1].parts[0].B[0])
    assert np.all(np.abs(gains(first, "holdout") / nominal - 1.0) <= 0.2)


@pytest.mark.parametrize(
    "name", ["three_dof_sliding_mode", "three_dof_disturbance_observer"]
)
def test_shipped_studies_build_and_start_inside_their_bounds(name):
    case = read(shipped(name))
    assert case.loop.controller is not None
    assert case.ensemble.stages("tune").plant.parts[1].parts[0].B[0].shape == (4,)
    assert tomllib.loads(shipped(name).read_text(encoding="utf-8"))["ensemble"]


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"references__amplitude": [1.0, 2.0]}, r"references.amplitude holds 2 values"),
        ({"sensor__noise_rms": [0.1] * 4}, r"sensor.noise_rms holds 4 values"),
        ({"actuator__lower": -1.0}, r"lower and upper must both be lists, or neither"),
        ({"references__tune": ["SIN5"]}, r"'SIN5' must be an axis, one of Z, Rx, Ry"),
        ({"references__tune": ["Q:SIN5"]}, r"'Q:SIN5' must be an axis"),
        ({"references__tune": ["Z:SIN300"]}, r"Z:SIN300 is not below half the rate"),
        ({"axes": {"names": ["Z", "Z"], "units": ["um", "um"]}}, r"names must differ"),
        ({"axes": {"names": ["Z", "R"], "units": ["um"] * 3}}, r"and have one unit"),
        ({"axes": {"names": ["Z", "z"], "units": ["um"] * 2}}, r"names are Z, z; "),
        ({"axes": {"names": ["Z", "R"], "units": ["um", "mm"]}}, r"'mm' is unknown"),
        ({"ensemble": {"spread": {"mass": 0.1}}}, r"mass is unknown; p558 varies in"),
        ({"ensemble": {"spread": {}}}, r"ensemble: spread, range and standard_err"),
        ({"controller": {"catalog": "p753_pid"}}, r"controller is a PID; it must map"),
    ],
)  # fmt: skip
def test_a_bad_study_is_refused(tables, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read(written(tmp_path, changed(**tables)))


def test_an_ensemble_needs_a_plant_with_deviations(tmp_path):
    text = shipped("p753_dob").read_text(encoding="utf-8")
    text = text.replace('"p753_stage"', '"p753"')
    path = tmp_path / "study.toml"
    path.write_text(text + "\n[ensemble]\nspread = { gain = 0.1 }\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"ensemble: plant.catalog must be one"):
        read(path)
