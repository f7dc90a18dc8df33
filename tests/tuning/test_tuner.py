"""Tuning of a small study, also with diverging loops and interrupts."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from study_tables import PID_ON_LAG, with_values

import piezojax as pj
from piezojax.catalog import p753
from piezojax.core.paths import get, parameters
from piezojax.signals import waveforms as signals
from piezojax.solve.optimisers import METHODS
from piezojax.study import Study, build
from piezojax.tuning import tuner
from piezojax.tuning.baselines import Budget
from piezojax.tuning.make_result import not_better_than_the_start
from piezojax.tuning.result import Result, load_result

# A PID on a lag compiles in a few seconds, and the tests do not depend on the loop.
WIDE = {"lower": -1e300, "upper": 1e300}
PROPORTIONAL, INTEGRAL = "controller.proportional", "controller.integral"
BASE = PID_ON_LAG | {
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "references": {
        "tune": ["SIN50", "SW50"],
        "duration": 0.05,
        "settle": 0.02,
    },
    "parameters": {
        PROPORTIONAL: {"lower": 0.1, "upper": 5.0, "scale": "log"},
        INTEGRAL: {"lower": 100.0, "upper": 2e4, "scale": "log"},
    },
    "optimiser": {"method": "bfgs", "starts": 2, "candidates": 4, "steps": 6},
}
RESULT_KEYS = {
    "gain_units",
    *("study", "status", "gains", "before", "after", "holdout"),
    *("evaluations", "compile_s", "wall_s", "versions", "seed"),
}
SCORE_KEYS = {"per_reference_rms_um", "geomean_rms_um", "worst_rms_um"}


def case_of(changes, seed=None):
    study = Study.model_validate(with_values(BASE, changes))
    return build(study, "small.toml", seed=seed)


class Recorder:
    """Progress that records its calls and may raise KeyboardInterrupt."""

    def __init__(self, stop_after=None, stop_stage=None):
        self.stages, self.bests = [], []
        self._after, self._stage = stop_after, stop_stage

    def stage(self, text, steps=0):
        self.stages.append((text, steps))
        if self._stage and text.startswith(self._stage):
            raise KeyboardInterrupt

    def advance(self, best):
        self.bests.append(best)
        if len(self.bests) == self._after:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def progress():
    return Recorder()


@pytest.fixture(scope="module")
def outcome(progress):
    """Return the outcome of the P-753 with hysteresis and an unseen reference."""
    changes = {
        "plant": {"catalog": "p753"},
        "references/unseen": ["TRI50"],
        "holdout_draws": 3,
    }
    return pj.tune(case_of(changes), progress=progress)


@pytest.fixture(scope="module")
def plain():
    return pj.tune(case_of({}))


def run(loop, name="SIN50", seed=9):
    """Return a run of 50 ms with its own noise."""
    time = signals.time_grid(0.05, 20_000.0)
    noise = jnp.asarray(np.random.default_rng(seed).standard_normal(time.size))
    reference = signals.signal(name, time)
    state = loop.init(reference[0])
    return pj.simulate(loop, pj.loop_inputs(reference, noise), state)[1]


def test_gains_with_a_larger_error_than_the_start_have_a_note(plain):
    before, after = plain.result.before, plain.result.after
    assert not any("than the start" in note for note in plain.result.warnings)
    assert not_better_than_the_start(before, after) == []
    (note,) = not_better_than_the_start(before, before)
    assert note.startswith("the search found no gains that are better than the start: ")
    (note,) = not_better_than_the_start(after, before)
    was, found = 1e3 * after.geomean_rms_um, 1e3 * before.geomean_rms_um
    assert f"{found:.4g} nm against {was:.4g} nm" in note
    limited = dict.fromkeys(before.saturated_percent, 100.0)
    railed = before.model_copy(update={"saturated_percent": limited})
    assert not_better_than_the_start(after, railed) == []
    lost = before.model_copy(update={"geomean_rms_um": None})
    assert not_better_than_the_start(after, lost) == []  # the alarm is more specific


# A successful run


def test_tuning_reduces_the_error_on_held_out_noise(outcome):
    result = outcome.result
    assert result.status in ("converged", "step limit")
    assert result.holdout.geomean_rms_um < 0.3 * result.holdout_before.geomean_rms_um
    assert result.unseen.geomean_rms_um < 0.5 * result.unseen_before.geomean_rms_um
    for name, error in result.holdout.per_reference_rms_um.items():
        assert error < result.holdout_before.per_reference_rms_um[name]


def test_only_gains_at_a_bound_have_a_note(outcome):
    space, gains = outcome.case.space, outcome.result.gains
    places = np.asarray(space.to_unit(jnp.asarray([*gains.values()])))
    expected = [
        path for path, x in zip(gains, places, strict=True) if not 0.01 < x < 0.99
    ]
    assert outcome.result.at_bound == expected
    assert len(expected) < len(gains)


def test_the_result_has_the_agreed_keys(outcome):
    result = json.loads(outcome.result.model_dump_json())
    assert set(result) >= RESULT_KEYS
    for part in ("before", "after", "holdout"):
        assert set(result[part]) >= SCORE_KEYS
        assert list(result[part]["per_reference_rms_um"]) == ["SIN50", "SW50"]
    assert list(result["unseen"]["per_reference_rms_um"]) == ["TRI50"]
    assert set(result["gains"]) == {PROPORTIONAL, INTEGRAL}
    assert {"piezojax", "jax", "jaxlib", "numpy"} <= set(result["versions"])
    assert result["study"] == "small"
    assert result["seed"] == 3
    assert 0.0 < result["compile_s"] < result["wall_s"]


def test_the_summary_figures_follow_from_the_references(outcome):
    result = outcome.result
    for part in (result.before, result.after, result.holdout, result.unseen):
        errors = list(part.per_reference_rms_um.values())
        mean = math.exp(sum(map(math.log, errors)) / len(errors))
        assert part.geomean_rms_um == pytest.approx(mean)
        assert part.worst_rms_um == max(errors)
        for name, error in part.per_reference_rms_um.items():
            assert part.peak_error_um[name] >= error


def test_scores_equal_those_of_a_plain_simulation():
    # Without noise nothing is drawn, so a plain run has the same error.
    found = pj.tune(case_of({"sensor/noise_rms": 0.0, "optimiser/steps": 1}))
    for loop, part in (
        (found.before, found.result.before),
        (found.after, found.result.after),
        (found.after, found.result.holdout),
    ):
        for name, error in part.per_reference_rms_um.items():
            log = run(loop, name)
            settled = np.asarray(log.displacement - log.reference)[400:]
            assert error == pytest.approx(np.sqrt(np.mean(settled**2)), rel=1e-9)
            assert part.peak_error_um[name] == pytest.approx(np.abs(settled).max())


def test_a_result_is_saved_and_loaded(outcome, tmp_path):
    (tmp_path / "result.json").write_text(outcome.result.model_dump_json())
    assert load_result(tmp_path) == outcome.result
    assert load_result(tmp_path / "result.json") == outcome.result
    assert isinstance(pj.load_result(tmp_path), Result)


def test_files_without_a_result_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"result.json: No such file or directory"):
        load_result(tmp_path)
    for content in ("", "{", "{}", '{"study": 3}'):
        (tmp_path / "result.json").write_text(content)
        with pytest.raises(ValueError, match=r"json is not a result of tuning: "):
            load_result(tmp_path)


def test_gains_are_inside_their_bounds_and_in_the_controller(outcome):
    case, result = outcome.case, outcome.result
    for path, low, high in zip(
        case.space.paths, case.space.lower, case.space.upper, strict=True
    ):
        assert low <= result.gains[path] <= high
        assert float(get(outcome.after, path)) == result.gains[path]
    assert outcome.controller is outcome.after.controller


def test_tuning_changes_the_tuned_parameters_only(outcome):
    before, after = parameters(outcome.before), parameters(outcome.after)
    assert before.keys() == after.keys()
    for path in before.keys() - outcome.result.gains.keys():
        assert before[path] == after[path]
    printed = parameters(p753.loop(p753.pid()))
    for path, value in outcome.result.start.items():
        assert value == pytest.approx(float(printed[path]))
        assert float(before[path]) == float(printed[path])


def test_tuning_and_holdout_noise_are_different(outcome):
    result = outcome.result
    for one, other in (
        (result.before, result.holdout_before),
        (result.after, result.holdout),
    ):
        for name, error in one.per_reference_rms_um.items():
            held = other.per_reference_rms_um[name]
            assert error != held
            assert error == pytest.approx(held, rel=0.2)


def test_noise_differs_between_references():
    found = pj.tune(
        case_of({"references/tune": ["CONST1", "CONST2"], "optimiser/steps": 1})
    )
    for part in (found.result.before, found.result.holdout_before):
        one, other = part.per_reference_rms_um.values()
        assert one != other
        assert 0.5 < one / other < 2.0
    # A stage that rests has no step, and so no overshoot.
    assert found.result.steps == {}
    assert found.result.alarms == []


def test_history_contains_the_lowest_loss_of_each_start(outcome):
    history = np.array(outcome.result.history, dtype=float)
    assert history.shape == (6, 2)
    assert np.all(np.diff(history, axis=0) <= 0.0)
    assert history[-1].min() < -1.0  # a logarithm: more than e times better
    assert outcome.result.evaluations == 5 + 2 * len(history)


def test_the_best_loss_agrees_with_the_scores(outcome):
    # The history of an optimistix method lags one step, so it is never better.
    result = outcome.result
    gain = math.log(result.after.geomean_rms_um / result.before.geomean_rms_um)
    best = min(loss for row in result.history for loss in row)
    assert gain <= best + 1e-9
    assert gain == pytest.approx(best, abs=0.5)


def test_progress_is_reported(outcome, progress):
    texts = [text for text, _ in progress.stages]
    assert texts == [
        "simulating the start",
        "screening 5 points of the box",
        "compiling the gradient",
        "tuning from 2 starts",
        "evaluating on held-out noise",
    ]
    assert dict(progress.stages)["tuning from 2 starts"] == 6
    assert len(progress.bests) == len(outcome.result.history)
    assert progress.bests == sorted(progress.bests, reverse=True)


def test_saved_gains_give_the_same_error(outcome, tmp_path):
    path = tmp_path / "gains.toml"
    pj.save(outcome.controller, path)
    loop = p753.loop(pj.load(path))
    found, expected = run(loop), run(outcome.after)
    np.testing.assert_array_equal(found.displacement, expected.displacement)
    np.testing.assert_array_equal(found.voltage, expected.voltage)


# Seeds


def stable_part(result):
    return result.model_dump(exclude={"compile_s", "times_s", "wall_s"})


def test_the_same_seed_gives_the_same_result(plain):
    again = pj.tune(case_of({}, seed=3))
    assert stable_part(again.result) == stable_part(plain.result)


def test_another_seed_draws_other_noise(plain):
    other = pj.tune(case_of({}, seed=4)).result
    assert other.seed == 4
    assert other.start == plain.result.start
    for part in ("before", "holdout_before"):
        old, new = getattr(plain.result, part), getattr(other, part)
        for name, error in new.per_reference_rms_um.items():
            assert error != old.per_reference_rms_um[name]
            assert error == pytest.approx(old.per_reference_rms_um[name], rel=0.2)


# Diverging starts, and boxes of diverging loops


def test_a_diverging_start_is_replaced_with_a_note():
    changes = {
        "actuator": WIDE,
        f"parameters/{INTEGRAL}/upper": 1e7,
        f"parameters/{INTEGRAL}/start": 5e6,
    }
    found = pj.tune(case_of(changes))
    result = found.result
    assert not result.before.stable
    assert result.before.geomean_rms_um is None
    assert result.before.per_reference_rms_um == {"SIN50": None, "SW50": None}
    assert any(
        "the study's own start diverges or stays at a voltage limit; tuning began "
        "from the best of 4" in text
        for text in result.warnings
    )
    assert result.holdout.geomean_rms_um < 1.0
    assert result.gains[INTEGRAL] < 1e6
    assert np.isfinite(run(found.after).displacement).all()
    json.loads(result.model_dump_json())  # no NaN, no Infinity


def test_a_box_of_diverging_loops_is_refused():
    changes = {
        "actuator": WIDE,
        f"parameters/{INTEGRAL}": {"lower": 3e6, "upper": 1e7, "start": 5e6},
    }
    with pytest.raises(
        ValueError,
        match="the loop diverges or stays at a voltage limit at the start and",
    ) as got:
        pj.tune(case_of(changes))
    assert str(got.value) == (
        "the loop diverges or stays at a voltage limit at the start and at all 4 "
        "points tried in the box: "
        "lower the bounds of the gains, raise 'candidates', or check the plant's sign "
        "and sample rate"
    )


# Ctrl-C


def assert_complete(found):
    result = found.result
    assert result.status == "interrupted"
    assert set(json.loads(result.model_dump_json())) >= RESULT_KEYS
    assert result.holdout.stable
    for path, value in result.gains.items():
        assert float(get(found.after, path)) == value


@pytest.mark.parametrize("steps", [1, 4])
def test_ctrl_c_keeps_the_best_so_far(plain, steps):
    found = pj.tune(case_of({}), progress=Recorder(stop_after=steps))
    assert_complete(found)
    assert found.result.history == plain.result.history[:steps]
    assert found.result.evaluations == 5 + 2 * steps
    assert found.result.after.geomean_rms_um <= found.result.before.geomean_rms_um


@pytest.mark.parametrize("stage", ["screening", "compiling the gradient", "tuning"])
def test_ctrl_c_before_the_first_step(stage):
    found = pj.tune(case_of({}), progress=Recorder(stop_stage=stage))
    assert_complete(found)
    assert found.result.history == []
    if stage == "screening":
        assert found.result.gains == pytest.approx(found.result.start)
    else:
        # The best of the points that were screened is already better.
        assert found.result.after.geomean_rms_um < found.result.before.geomean_rms_um


def test_an_interrupted_search_has_no_front_and_no_baselines(monkeypatch):
    called = []
    for name in ("trace_front", "compare_baselines"):
        monkeypatch.setattr(tuner, name, lambda *_, name=name: called.append(name))
    limited = {
        "constraints": {"sensitivity_peak": 2.0},
        "pareto": {"constraint": "sensitivity_peak", "limits": [1.5, 1.8]},
    }
    for stop, expected in ((1, []), (None, ["trace_front", "compare_baselines"])):
        called.clear()
        recorder = Recorder(stop_after=stop)
        found = pj.tune(case_of(limited), baselines=Budget(), progress=recorder)
        assert called == expected
        assert found.result.front is None
        assert found.baselines is None


# Saturation


def test_saturation_is_reported():
    changes = {
        "plant": {"catalog": "p753"},
        "references/unseen": ["TRI50"],
        # The references require 10 kV/s and more.
        "actuator/slew_rate": 2e3,
    }
    result = pj.tune(case_of(changes)).result
    for part in (result.after, result.holdout):
        assert all(share > 1.0 for share in part.saturated_percent.values())
    for where in ("tuning", "hold-out"):
        text = (
            f"the actuator saturates on {where} runs of SIN50, SW50: a controller of "
            "your own needs the limits of [actuator], too"
        )
        assert text in result.warnings


def test_no_saturation_is_not_reported(plain):
    result = plain.result
    assert set(result.holdout.saturated_percent.values()) == {0.0}
    assert not any("saturates" in text for text in result.warnings)


# Objectives and optimisers


# Here effort and slew grow monotonically with the integral gain.
WEIGHTED = {
    "references/tune": ["SIN50"],
    "parameters": {INTEGRAL: {"lower": 1.0, "upper": 2e4, "scale": "log"}},
}


def effort_and_slew(loop):
    log = run(loop)
    voltage = np.asarray(log.voltage)[400:]
    return np.sqrt(np.mean(voltage**2)), np.sqrt(np.mean(np.diff(voltage) ** 2))


@pytest.fixture(scope="module")
def light():
    return pj.tune(case_of(WEIGHTED | {"objective/effort_weight": 1e5}))


def test_a_weight_on_effort_lowers_the_effort(light):
    assert effort_and_slew(light.after)[0] < 0.5 * effort_and_slew(light.before)[0]


def test_gains_at_a_bound_have_a_note(light):
    result = light.result
    assert result.at_bound == [INTEGRAL]
    assert f"at the edge of its bounds: {INTEGRAL} (lower)" in result.warnings
    assert result.gains[INTEGRAL] == pytest.approx(1.0, rel=0.2)


def test_a_weight_on_slew_lowers_the_slew():
    found = pj.tune(case_of(WEIGHTED | {"objective/slew_weight": 1e5}))
    assert effort_and_slew(found.after)[1] < 0.5 * effort_and_slew(found.before)[1]


@pytest.mark.parametrize(
    ("method", "aggregate"),
    [("lbfgsb", "worst"), ("levenberg_marquardt", "mean_square")],
)
def test_other_methods_and_objectives_reduce_the_error(method, aggregate):
    changes = {"optimiser/method": method, "objective/aggregate": aggregate}
    result = pj.tune(case_of(changes)).result
    assert method in METHODS
    assert result.method == method
    assert result.holdout.geomean_rms_um < 0.5 * result.holdout_before.geomean_rms_um
    assert result.holdout.worst_rms_um < result.holdout_before.worst_rms_um
    history = np.array(result.history, dtype=float)
    assert np.all(np.diff(history, axis=0) <= 0.0)


def test_one_start_without_candidates():
    changes = {"method": "bfgs", "starts": 1, "candidates": 0, "steps": 3}
    result = pj.tune(case_of({"optimiser": changes})).result
    assert result.evaluations == 1 + 3
    assert result.after.geomean_rms_um < result.before.geomean_rms_um


def test_an_unknown_study_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"study .*no.toml: No such file or directory"):
        pj.tune(tmp_path / "no.toml")


def test_a_box_of_saturated_loops_is_refused_or_called_unstable():
    bounds = {"lower": 3e6, "upper": 1e7, "start": 5e6}
    try:
        result = pj.tune(case_of({f"parameters/{INTEGRAL}": bounds})).result
    except ValueError:
        return
    assert not result.before.stable


def test_a_saturated_start_has_a_warning():
    changes = {
        f"parameters/{INTEGRAL}/upper": 1e7,
        f"parameters/{INTEGRAL}/start": 5e6,
    }
    result = pj.tune(case_of(changes)).result
    assert min(result.before.saturated_percent.values()) > 50.0
    assert any("start" in text or "before" in text for text in result.warnings)


def test_ctrl_c_during_the_evaluation_keeps_the_gains():
    recorder = Recorder(stop_stage="judging")
    try:
        found = pj.tune(case_of({}), progress=recorder)
    except KeyboardInterrupt:
        pytest.fail("nothing came back")
    assert set(found.result.gains) == {PROPORTIONAL, INTEGRAL}
