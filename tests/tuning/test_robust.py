"""Robust tuning: ensembles, limits, the augmented Lagrangian, the Pareto front."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
import tomli_w

import piezojax as pj
from piezojax.analysis.constraints import (
    CONSTRAINTS,
    constraint_count,
    violations,
    worst_excess,
)
from piezojax.analysis.loop_figures import LoopFigures
from piezojax.analysis.stability import OperatingPoint, stability_report
from piezojax.analysis.stability.sampled_margins import BANDS
from piezojax.analysis.step_response import StepFigures
from piezojax.catalog import p753, p753_stage
from piezojax.core.metrics import ExtremeFigures, TrackingFigures
from piezojax.core.paths import replace
from piezojax.core.system import rest_output
from piezojax.solve.augmented_lagrangian import penalty_terms, update_multipliers
from piezojax.solve.clock import Clock
from piezojax.study import Stage, load, read
from piezojax.tuning import evaluator
from piezojax.tuning.data import make_data
from piezojax.tuning.evaluator import Carried
from piezojax.tuning.limited_search import searched_limits
from piezojax.tuning.objective import Objective

STUDY = {
    "title": "integral action on the P-753",
    "rate": 20000.0,
    "seed": 5,
    "plant": {"catalog": "p753_stage"},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.001},
    "disturbance": {"drift_rms": 0.02},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 200.0, "dt": 5e-5},
    "references": {
        "tune": ["SIN50", "SIN20"],
        "amplitude": 2.0,
        "duration": 0.05,
        "settle": 0.02,
    },
    "parameters": {
        "controller.integral": {"lower": 20.0, "upper": 2e4, "scale": "log"}
    },
    "ensemble": {
        "spread": {"gain": 0.2, "poles": 0.1, "sensor.noise.noise_rms": 0.5},
        "range": {"mode_frequency": [2000.0, 6000.0], "delay": [0.0, 1.0]},
        "tune": 2,
        "margins": 4,
        "holdout": 5,
    },
    "constraints": {
        "sensitivity_peak": 1.3,
        "delay_margin": 3.0,
        "overshoot": 0.5,
        "peak_voltage": 100.0,
        "peak_slew": 1e6,
        "effort": 50.0,
    },
    "pareto": {"constraint": "sensitivity_peak", "limits": [1.2, 1.4], "steps": 10},
    "optimiser": {
        "method": "gauss_newton",
        "starts": 2,
        "candidates": 3,
        "steps": 10,
    },
}


def written(folder, study, name="study.toml"):
    path = folder / name
    path.write_text(tomli_w.dumps(study), encoding="utf-8")
    return path


def changed(**tables):
    """Return STUDY with tables replaced; ``a__b`` sets key b of table a."""
    study = json.loads(json.dumps(STUDY))
    for name, value in tables.items():
        table, _, key = name.partition("__")
        if key:
            study[table][key] = value
        elif value is None:
            del study[table]
        else:
            study[table] = value
    return study


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    return pj.tune(written(tmp_path_factory.mktemp("robust"), STUDY))


def exact_peak(loop, stage):
    """Return Ms on the worse branch at the top of the references, by poles and QR."""
    other = stage.around(loop)
    reports = [
        stability_report(other, OperatingPoint(4.0, b))
        for b in ("ascending", "descending")
    ]
    return max(report.sensitivity_peak for report in reports)


def each(stages):
    count = jax.tree.leaves(stages)[0].shape[0]
    return [jax.tree.map(lambda x, i=i: x[i], stages) for i in range(count)]


# The augmented Lagrangian


def test_multipliers_of_a_known_problem():
    """Minimise (x-3)^2 with ln x <= ln 2: x = 2, multiplier -(df/dx) / (dg/dx) = 4."""

    def total(x, multipliers, penalty):
        added = penalty_terms(jnp.log(x / 2.0)[None], multipliers, penalty)
        return (x - 3.0) ** 2 + jnp.sum(added**2)

    @jax.jit
    def newton(x, multipliers):
        slope = jax.grad(total)(x, multipliers, penalty)
        return x - slope / jax.hessian(total)(x, multipliers, penalty)

    x, multipliers, penalty = jnp.asarray(3.0), jnp.zeros(1), jnp.asarray(5.0)
    for _ in range(30):
        for _ in range(10):
            x = newton(x, multipliers)
        multipliers = update_multipliers(jnp.log(x / 2.0)[None], multipliers, penalty)
    assert x == pytest.approx(2.0, abs=1e-6)
    assert multipliers[0] == pytest.approx(4.0, rel=1e-4)


def test_kept_constraints_have_no_cost():
    added = penalty_terms(jnp.array([-0.1, 0.2]), jnp.zeros(2), jnp.asarray(8.0))
    np.testing.assert_allclose(added, [0.0, 2.0 * 0.2])


# Limits


@pytest.mark.parametrize(
    "names", [CONSTRAINTS, ["effort"], ["delay_margin", "peak_slew"], []]
)
def test_constraint_count_equals_the_number_of_violations(names):
    runs = jnp.ones((3, 2, 1))
    figures = LoopFigures(
        TrackingFigures(*[runs] * len(TrackingFigures._fields)),
        ExtremeFigures(*[runs] * len(ExtremeFigures._fields)),
        dict.fromkeys(names, jnp.ones((5, 2)))
        | {"sensitivity_peak": jnp.ones((5, 2, BANDS))},
        StepFigures(*[jnp.ones((3, 4))] * len(StepFigures._fields)),
        dt=5e-5,
    )
    limits = dict.fromkeys(names, 1.5)
    assert constraint_count(limits, 3, 5) == violations(limits, figures).size


def test_the_worst_excess_is_that_of_any_margin_branch_or_band():
    limits = {"sensitivity_peak": 2.0, "delay_margin": 1.0}
    peaks = np.ones((3, 2, BANDS))
    peaks[1, 0, 7] = 4.0
    delays = np.full((3, 2), 0.5)
    delays[2] = 3.0, 0.25
    margins = {
        "sensitivity_peak": jnp.asarray(peaks),
        "delay_margin": jnp.asarray(delays),
    }
    expected = np.log([2.0, 2.0, 4.0])
    np.testing.assert_allclose(worst_excess(limits, margins), expected)


def test_the_limit_is_kept_and_active_at_the_exact_margin(outcome):
    kept = outcome.result.constraints["sensitivity_peak"]
    assert (kept.kept, kept.active, kept.of) == (True, True, 5)
    stages = each(outcome.case.ensemble.stages("margins"))
    assert len(stages) == 4
    own = exact_peak(outcome.after, Stage(
        outcome.case.loop.plant, outcome.case.loop.sensor))  # fmt: skip
    worst = max(own, *(exact_peak(outcome.after, stage) for stage in stages))
    assert kept.value == pytest.approx(worst, rel=2e-3)
    assert worst == pytest.approx(0.99 * 1.3, rel=5e-3)  # the reserve of drawn plants


def test_a_search_on_the_worst_plants_keeps_the_limit_on_all(
    outcome, monkeypatch, tmp_path
):
    monkeypatch.setattr(evaluator, "CARRIED", 2)
    found = pj.tune(written(tmp_path, changed(pareto=None))).result
    kept = found.constraints["sensitivity_peak"]
    assert (kept.kept, kept.active, kept.of) == (True, True, 5)
    assert found.gains == pytest.approx(outcome.result.gains, rel=2e-3)


def test_the_worst_plants_are_those_with_the_largest_exact_peak(outcome, monkeypatch):
    monkeypatch.setattr(evaluator, "CARRIED", 2)
    case = dataclasses.replace(
        outcome.case,
        study=outcome.case.study.model_copy(
            update={"constraints": {"sensitivity_peak": 1.3, "delay_margin": "off"}}
        ),
    )
    found = evaluator.Evaluator(Clock(), case)
    beyond, _, worst, places = found.worst_plants(outcome.after)
    own = Stage(case.loop.plant, case.loop.sensor)
    stages = [own, *each(case.ensemble.stages("margins"))]
    peaks = sorted((exact_peak(outcome.after, stage) for stage in stages), reverse=True)
    carried = [exact_peak(outcome.after, stage) for stage in each(worst)]
    assert carried == pytest.approx(peaks[:2], rel=1e-9)
    # Half of them were in the search before.
    for old in set(range(5)) - set(places.tolist()):
        again = found.worst_plants(
            outcome.after, Carried(0.0, 0.0, None, np.array([old]))
        )
        assert again.places.tolist() == [places[0], old]
    assert beyond == pytest.approx(np.log(peaks[0] / 1.3), abs=2e-3)


def test_a_search_on_drawn_plants_leaves_a_reserve(outcome):
    """Margins only: the worst of other plants is worse than that of those drawn."""
    written = {"sensitivity_peak": 2.0, "delay_margin": 3.0, "effort": 50.0}
    expected = {"sensitivity_peak": 1.98, "delay_margin": 3.03, "effort": 50.0}
    assert searched_limits(written, True) == pytest.approx(expected)
    assert searched_limits(written, False) == written
    kept = outcome.result.constraints["sensitivity_peak"]
    assert kept.value == pytest.approx(0.99 * kept.limit, rel=3e-3)


def test_larger_gains_violate_the_limit(outcome):
    """The error falls with the single gain, so only the limit bounds it."""
    (gain,) = outcome.result.gains.values()
    larger = replace(outcome.case.loop, {"controller.integral": 1.05 * gain})
    stages = each(outcome.case.ensemble.stages("margins"))
    assert max(exact_peak(larger, stage) for stage in stages) > 1.3
    assert outcome.result.after.geomean_rms_um < outcome.result.before.geomean_rms_um


def test_held_out_plants_are_evaluated_separately(outcome):
    found = outcome.result.perturbed
    stages = each(outcome.case.ensemble.stages("holdout"))
    peaks = [exact_peak(outcome.after, stage) for stage in stages]
    np.testing.assert_allclose(found.values["sensitivity_peak"], peaks, rtol=2e-3)
    within = sum(peak <= 1.3 for peak in peaks)
    assert found.constraints["sensitivity_peak"].on == within
    assert (found.plants, found.unstable) == (5, 0)
    ratios = np.divide(found.geomeans_before_um, found.geomeans_um)
    assert found.median_better == pytest.approx(np.median(ratios))
    assert found.worst_better == pytest.approx(ratios.min())


def test_the_front_trades_error_for_robustness(outcome):
    loose, tight = outcome.result.front
    assert (loose.limit, tight.limit) == (1.4, 1.2)
    assert loose.kept
    assert tight.kept
    assert loose.value == pytest.approx(1.4, rel=0.02)
    assert tight.value == pytest.approx(1.2, rel=0.02)
    assert loose.geomean_rms_um < tight.geomean_rms_um


def test_the_result_is_saved_and_loaded(outcome, tmp_path):
    (tmp_path / "result.json").write_text(outcome.result.model_dump_json())
    assert pj.load_result(tmp_path) == outcome.result


def test_figures_of_runs_equal_those_of_their_logs(outcome):
    """Compare voltage, slew, effort and overshoot with NumPy on complete logs."""
    found, case = outcome.result.constraints, outcome.case
    signals = make_data(case).tuning
    own = Stage(case.loop.plant, case.loop.sensor)

    @eqx.filter_jit
    def logged(stage, *signals):
        loop = stage.around(outcome.after)
        return pj.simulate(loop, pj.loop_inputs(*signals), loop.init(signals[0][0]))[1]

    logs = [
        jax.tree.map(
            np.asarray,
            logged(
                stage,
                signals.references[run],
                signals.noise[run, 0],
                signals.disturbance[run, 0],
            ),
        )
        for stage in (own, *each(case.ensemble.stages("tune")))
        for run in range(2)
    ]
    assert len(logs) == 6
    voltage = [log.voltage for log in logs]
    assert found["peak_voltage"].value == pytest.approx(
        max(np.abs(v).max() for v in voltage)
    )
    assert found["peak_slew"].value == pytest.approx(
        max(np.abs(np.diff(v[400:])).max() for v in voltage) / 5e-5
    )
    assert found["effort"].value == pytest.approx(
        max(np.sqrt(np.mean(v[400:] ** 2)) for v in voltage)
    )
    beyond = [
        max(
            log.displacement.max() - log.reference.max(),
            log.reference.min() - log.displacement.min(),
        )
        / np.ptp(log.reference)
        for log in logs
    ]
    assert found["overshoot"].value == pytest.approx(max(*beyond, 0.0))


# Ensembles


def test_draws_are_within_the_ranges_of_the_study(tmp_path):
    ensemble = read(written(tmp_path, STUDY)).ensemble
    stages = ensemble.stages("holdout")
    other = read(written(tmp_path, changed(ensemble__holdout=300), "more.toml"))
    plants = other.ensemble.stages("holdout").plant.parts
    names = p753_stage.stage().names
    gain = np.asarray(plants[names.index("gain")].gain)
    assert 0.8 <= gain.min() < 0.81
    assert 1.19 < gain.max() <= 1.2
    hertz = np.asarray(plants[names.index("mode")].frequency) / (2.0 * np.pi)
    assert 2000.0 <= hertz.min() < 2060.0
    assert 5940.0 < hertz.max() <= 6000.0
    delay = np.asarray(plants[names.index("delay")].delay) / 5e-5
    assert 0.0 <= delay.min() < 0.02
    noise = np.asarray(other.ensemble.stages("holdout").sensor.parts[0].noise_rms)
    assert 0.0005 <= noise.min() < noise.max() <= 0.0015
    first = each(ensemble.stages("tune"))[0], each(ensemble.stages("margins"))[0]
    assert jax.tree.all(jax.tree.map(jnp.array_equal, *first))
    assert not jnp.isin(stages.plant.parts[names.index("gain")].gain, gain[5:]).any()


def test_holdout_and_tuning_have_different_plants(tmp_path):
    ensemble = read(written(tmp_path, STUDY)).ensemble
    gain = p753_stage.stage().names.index("gain")
    held, seen = (
        np.asarray(ensemble.stages(part).plant.parts[gain].gain)
        for part in ("holdout", "margins")
    )
    assert held.size == 5
    assert not np.isin(held, seen).any()


def test_a_stage_without_deviation_is_the_printed_one_with_creep_and_mode():
    stage = p753_stage.stage()
    printed = p753.plant()
    named = dict(zip(stage.names, stage.parts, strict=True))
    for one, other in zip(
        jax.tree.leaves(named["dynamics"]),
        jax.tree.leaves(printed.parts[1]),
        strict=True,
    ):
        assert one == pytest.approx(float(other), rel=1e-12)
    assert named["mode"].init(1.0)[0] == 1.0


def test_poles_and_zeros_move_along_their_rays():
    named = dict(zip(p753_stage.stage().names, p753_stage.stage(
        poles=0.2, zeros=-0.1, gain=0.1).parts, strict=True))  # fmt: skip
    printed = p753.plant().parts[1]
    expected = np.sort(printed.poles() ** 1.2)
    np.testing.assert_allclose(np.sort(named["dynamics"].poles()), expected)
    expected = np.sort_complex(printed.zeros() ** 0.9)
    np.testing.assert_allclose(np.sort_complex(named["dynamics"].zeros()), expected)
    assert named["dynamics"].dc_gain() == pytest.approx(1.0)
    assert named["gain"].gain == pytest.approx(1.1)


def test_every_deviation_changes_its_part_of_the_stage():
    names = p753_stage.stage().names

    def part(name, **deviations):
        return p753_stage.stage(**deviations).parts[names.index(name)]

    # At rest the creep is complete: 1 % of a step in each of three decades.
    assert rest_output(part("creep"), 1.0) == pytest.approx(1.03, rel=1e-12)
    less = part("creep", creep=-0.5)
    assert rest_output(less, 1.0) == pytest.approx(1.015, rel=1e-12)
    # y' = |x'| (a x + c y) + b x' with a and c doubled is half of it at twice x.
    drive = 40.0 * np.sin(2.0 * np.pi * np.arange(400) / 200.0)
    found = pj.simulate(part("hysteresis", hysteresis=1.0), drive)[1]
    twice = pj.simulate(part("hysteresis"), 2.0 * drive)[1]
    np.testing.assert_allclose(2.0 * found, twice, rtol=0.0, atol=1e-12)
    ramp = pj.simulate(part("delay", delay=0.4), np.arange(4.0))[1]
    np.testing.assert_allclose(ramp[1:], np.arange(1.0, 4.0) - 0.4, atol=1e-12)
    # 4 kHz at 20 kHz: nearly undamped, a fifth of a period per sample.
    ringing = pj.simulate(part("mode", mode_damping=1e-9), np.ones(10))[1]
    turns = np.arange(1, 11) / 5.0
    np.testing.assert_allclose(ringing, 1.0 - np.cos(2.0 * np.pi * turns), atol=1e-6)


def test_draws_follow_the_standard_errors_of_a_fit(tmp_path):
    fit = {"parameters": {
        "dynamics.moving.0": {"value": 1.0, "standard_error": 1e-3},
        "hysteresis.a": {"value": 1.0, "standard_error": None},
        "input before the record": {"value": 0.0, "standard_error": None},
    }}  # fmt: skip
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    tables = {"standard_errors": "fit.json", "holdout": 400}
    study = changed(ensemble=tables)
    case = read(written(tmp_path, study))
    drawn = case.ensemble.stages("holdout").plant.parts
    names = p753_stage.stage().names
    first = np.asarray(drawn[names.index("dynamics")].moving[0])
    own = float(p753_stage.stage().parts[names.index("dynamics")].moving[0])
    assert np.mean(first) == pytest.approx(own, abs=2e-4)
    assert np.std(first) == pytest.approx(1e-3, rel=0.1)
    assert np.ptp(np.asarray(drawn[0].a)) == 0.0
    (note,) = [note for note in case.notes if "standard error" in note]
    assert "fit.json has no standard error of plant.hysteresis.a, which the" in note
    assert "before" not in note
    varied = tables | {"spread": {"plant.hysteresis.a": 0.1}}
    assert read(written(tmp_path, changed(ensemble=varied))).ensemble.notes == ()


def vague(folder, **errors):
    """Return the ensemble of a resonance (Hz, ratio) with these standard errors."""
    values = {"frequency": 400.0, "damping": 0.02}
    fit = {name: {"value": values[name], "standard_error": errors[name]}
           for name in errors}  # fmt: skip
    (folder / "fit.json").write_text(json.dumps({"parameters": fit}))
    study = changed(
        plant={"type": "Mode", "dt": 5e-5, **values},
        ensemble={"standard_errors": "fit.json", "holdout": 1000},
    )
    return read(written(folder, study)).ensemble


def test_draws_stay_within_the_limits_of_a_parameter(tmp_path):
    """A normal distribution that is cut off at 0, like that of SciPy."""
    error = 0.03
    damping = np.asarray(vague(tmp_path, damping=error).stages("holdout").plant.damping)
    assert damping.min() > 0.0
    law = scipy.stats.truncnorm(-0.02 / error, np.inf, loc=0.02, scale=error)
    assert scipy.stats.kstest(damping, law.cdf).pvalue > 0.01
    # Draws within the limits are those of the same seed without limits.
    close = np.asarray(vague(tmp_path, damping=1e-4).stages("holdout").plant.damping)
    plain = 0.02 + error * (close - 0.02) / 1e-4
    assert 0.2 < np.mean(plain <= 0.0) < 0.3
    np.testing.assert_allclose(damping[plain > 0.0], plain[plain > 0.0], rtol=1e-6)


def test_a_standard_error_far_beyond_the_limits_is_refused(tmp_path):
    """A normal distribution has 2/3 of the first, 0.004 of the second below Nyquist."""
    plant = {"type": "LowPass", "frequency": 4000.0, "dt": 5e-5}
    table = {"standard_errors": "fit.json", "holdout": 200}
    study = written(tmp_path, changed(plant=plant, ensemble=table))
    for error in (5e3, 1e6):
        fit = {"frequency": {"value": 4000.0, "standard_error": error}}
        (tmp_path / "fit.json").write_text(json.dumps({"parameters": fit}))
        if error < 1e6:
            drawn = read(study).ensemble.stages("holdout").plant.frequency
            assert 0.0 < drawn.min() < drawn.max() < 1e4
            continue
        with pytest.raises(ValueError, match="but its limits are 0 and 10000: the"):
            read(study)


@pytest.mark.parametrize(
    ("over", "tail"), [("mean", 1.0), ("worst", 1.0), ("cvar", 0.4)]
)
def test_plants_are_aggregated_by_the_named_rule(over, tail, tmp_path):
    none = jnp.zeros((5, 2, 1))
    rms = jnp.exp(jnp.arange(10.0).reshape(5, 2, 1) % 7.0)
    figures = TrackingFigures(rms, none, none, none, none, none)
    case = read(written(tmp_path, STUDY))
    objective = Objective(
        case.loop,
        case.space,
        make_data(case).tuning,
        jnp.ones((5, 2)),
        jnp.asarray(1.0),
        0,
    )
    objective = dataclasses.replace(objective, over=over, tail=tail)
    each_plant = np.sort(np.mean(np.arange(10.0).reshape(5, 2) % 7.0, axis=1))
    expected = {
        "mean": each_plant.mean(),
        "worst": each_plant[-1],
        "cvar": each_plant[-2:].mean(),
    }[over]
    assert objective._error(figures) == pytest.approx(expected, abs=1e-6)


def test_drift_is_a_random_walk_of_the_stage(tmp_path):
    study = changed(disturbance={"drift_rms": 0.5}, holdout_draws=64)
    signals = make_data(read(written(tmp_path, study))).holdout
    walk = np.asarray(signals.disturbance)
    # 0.5 um after a second, so 0.5 sqrt(0.05) after this run
    assert np.std(walk[..., -1]) == pytest.approx(0.5 * np.sqrt(0.05), rel=0.15)
    assert np.std(np.diff(walk, axis=-1)) == pytest.approx(
        0.5 * np.sqrt(5e-5), rel=0.02
    )


# Errors


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"constraints__sensitivity_peak": 1.0}, r"constraints.sensitivity_peak is 1"),
        ({"constraints__phase": 1.0}, r"constraints.phase is unknown; allowed are"),
        ({"pareto__constraint": "disk_margin"}, r"constraint is 'disk_margin'"),
        ({"pareto__constraint": "speed"}, r"'speed' is unknown; there are"),
        ({"ensemble__range": {"delay": [1.0, 0.0]}}, r"range.delay is 1 to 0"),
        ({"ensemble__range": {"gain": [0.0, 1.0]}}, r"gain is in both spread"),
        ({"ensemble__spread": {"mass": 0.1}}, r"spread.mass is unknown"),
        ({"ensemble__spread": {"plant.x": 0.1}}, r"ensemble.spread: no param"),
        ({"ensemble__standard_errors": "no.json"}, r"standard_errors: .*no.json"),
        ({"ensemble__aggregate": "cvor"}, r"ensemble.aggregate is 'cvor'"),
        ({"disturbance__drift_rms": -1.0}, r"disturbance.drift_rms is -1.0"),
    ],
)  # fmt: skip
def test_a_bad_study_is_refused(tables, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read(written(tmp_path, changed(**tables)))


def test_every_study_has_default_limits(tmp_path):
    def limits(constraints):
        return load(written(tmp_path, STUDY | {"constraints": constraints})).limits

    study = {key: STUDY[key] for key in STUDY if key != "pareto"}
    assert load(written(tmp_path, study | {"constraints": {}})).limits == {
        "sensitivity_peak": 2.0,
        "delay_margin": 1.0,
    }
    assert limits({"sensitivity_peak": 1.5, "delay_margin": "off", "effort": 9.0}) == {
        "sensitivity_peak": 1.5,
        "effort": 9.0,
    }
    with pytest.raises(ValueError, match=r"delay_margin is 'of'; .* above 0, or 'off'"):
        limits({"delay_margin": "of"})


@pytest.mark.parametrize("name", CONSTRAINTS)
@pytest.mark.parametrize("limit", [0.0, -1.0, float("inf"), float("nan"), "low", True])
def test_meaningless_limits_are_refused(name, limit):
    with pytest.raises(ValueError, match=rf"{name} is .*; it must be a number above"):
        CONSTRAINTS[name].check(name, limit)
