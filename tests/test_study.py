"""Study files: valid ones are built, errors are named in one line."""

import json
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from stand_ins import fit_of
from study_tables import GONE, PID_ON_LAG, with_values

from piezojax import About, save
from piezojax.catalog import CONTROLLERS, p753
from piezojax.control import PID, DisturbanceObserverControl
from piezojax.core.parameter import declarations
from piezojax.core.paths import get, parameters
from piezojax.core.serial import to_data
from piezojax.core.space import Range
from piezojax.dynamics import FirstOrderLag
from piezojax.hysteresis import ShapedColemanHodgdon
from piezojax.study import (
    DEFAULT,
    build,
    is_comparison_study,
    load,
    load_comparison_study,
    read,
    shipped,
)
from piezojax.study.ensemble_table import EnsembleTable
from piezojax.study.parameters import _reaching

SHIPPED = sorted(path.stem for path in shipped().parent.glob("*.toml"))

BASE = PID_ON_LAG | {
    "references": {
        "tune": ["SIN50", "SW50"],
        "unseen": ["TRI50"],
        "amplitude": 5.0,
        "duration": 0.05,
        "settle": 0.02,
    },
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 5.0, "scale": "log"},
        "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"},
    },
    "objective": {"aggregate": "geometric_mean"},
    "optimiser": {"method": "bfgs", "starts": 2, "candidates": 4, "steps": 6},
}
UNSAFE = About(unsafe=["Ms 3 is above 2"])


@pytest.fixture
def study(tmp_path):
    def written(changes):
        path = tmp_path / "stage.toml"
        path.write_text(tomli_w.dumps(with_values(BASE, changes)), encoding="utf-8")
        return path

    return written


@pytest.fixture
def refusal(study):
    def message(changes):
        with pytest.raises(ValueError, match=r".") as caught:
            read(study(changes))
        text = str(caught.value)
        assert "\n" not in text
        return text

    return message


# Valid studies


def test_the_package_contains_studies():
    assert DEFAULT in SHIPPED
    assert len(SHIPPED) >= 2


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_studies_are_valid(name):
    study = load(shipped(name))
    assert study.parameters
    assert study.references.unseen


def test_the_ranges_of_the_plants_are_named():
    ranges = load(shipped("nv200")).ensemble.ranges
    assert ranges[0] == "gain +- 10 %"
    assert ranges[-1] == "mode_damping 0.01 to 0.03"
    table = EnsembleTable(standard_errors=Path("out") / "fit.json")
    assert table.ranges == ["the standard errors of fit.json"]


def test_the_default_study_has_a_realistic_stage_and_rivals():
    case = read(shipped())
    assert case.name == DEFAULT
    assert case.study.ensemble.holdout == 200
    assert {"2-DOF PID", "2-DOF PID with notch", "H-infinity"} < set(case.beside)
    # The stage, its electronics, its deviations and the references are those of the
    # comparison that tuned the others.
    own, fair = (
        tomllib.loads(shipped(name).read_text(encoding="utf-8"))
        for name in (DEFAULT, "comparison/p753_fair")
    )
    shared = set(own) & set(fair) - {"title", "optimiser"}
    assert len(shared) == 8
    assert {name: own[name] for name in shared} == {name: fair[name] for name in shared}


def test_the_study_of_the_thesis():
    case = read(shipped("p753_dob"))
    assert case.fit is None
    assert case.study.rate == p753.RATE
    assert case.study.references.tune == (
        *("SIN1", "SIN10", "SIN30", "SIN50", "SW10", "SW30", "SW50"),
        *("PWSW10", "PWSW30", "PWSW50"),
    )
    assert float(case.loop.sensor.parts[0].noise_rms) == 0.012
    np.testing.assert_array_equal(
        [case.loop.actuator.parts[0].lower, case.loop.actuator.parts[0].upper],
        p753.VOLTAGE_LIMITS,
    )
    # It starts from the printed gains.
    printed = parameters(CONTROLLERS["p753_disturbance_observer"]())
    for path in case.space.paths:
        assert get(case.loop, path) == printed[path.removeprefix("controller.")]


@pytest.mark.slow
def test_a_plant_from_a_record():
    path = shipped("micromanipulator")
    case = read(path)
    assert case.fit.system is case.loop.plant
    assert (case.fit.train.start, case.fit.train.stop) == (0, 1200)
    assert case.fit.report.validation.rmse <= 0.40


def test_a_small_study(study):
    case = read(study({}))
    assert case.name == "stage"
    assert case.study.dt == pytest.approx(5e-5)
    assert isinstance(case.loop.plant, FirstOrderLag)
    assert case.space.paths == ("controller.proportional", "controller.integral")
    assert case.space.scales == ("log", "log")
    np.testing.assert_array_equal(case.space.lower, [0.1, 100.0])
    np.testing.assert_array_equal(case.space.upper, [5.0, 2e4])


def test_optional_entries_have_defaults(study):
    gone = ("seed", "sensor", "objective", "optimiser", "references/unseen")
    case = read(study(dict.fromkeys(gone, GONE)))
    assert case.study.seed == 0
    assert case.study.optimiser.method == "gauss_newton"
    assert case.study.objective.aggregate == "geometric_mean"
    assert float(case.loop.sensor.parts[0].noise_rms) == 0.0


def test_another_seed(study):
    path = study({})
    assert read(path, seed=11).study.seed == 11
    assert build(load(path), path).study.seed == 3


def test_start_replaces_the_value_of_the_controller(study):
    case = read(study({"parameters/controller.integral/start": 777.0}))
    assert get(case.loop, "controller.integral") == 777.0
    assert get(case.loop, "controller.proportional") == p753.pid().proportional
    start = case.space.from_unit(case.space.start(case.loop))
    np.testing.assert_allclose(start, [p753.pid().proportional, 777.0])


# Values from the declarations


PROPORTIONAL, INTEGRAL = "controller.proportional", "controller.integral"


def declared_range(path):
    """Return the range that PID declares for a path."""
    declared = dict(declarations(PID))[path.removeprefix("controller.")]
    return Range(*declared.typical, declared.scale)


def test_a_path_without_a_range_has_the_declared_range(study):
    case = read(study({"parameters": GONE, "tune": [INTEGRAL, PROPORTIONAL]}))
    assert case.space.ranges() == {
        path: declared_range(path) for path in (INTEGRAL, PROPORTIONAL)
    }


def test_a_partial_range_is_completed_by_the_declaration(study):
    tables = {PROPORTIONAL: {"lower": 0.2}, INTEGRAL: {"scale": "linear"}}
    found = read(study({"parameters": tables})).space.ranges()
    assert found[PROPORTIONAL] == replace(declared_range(PROPORTIONAL), lower=0.2)
    assert found[INTEGRAL] == replace(declared_range(INTEGRAL), scale="linear")


def test_a_pattern_adds_every_matching_parameter(study):
    tables = {"controller.derivative": {"start": 1e-5, "upper": 1e-3}}
    starts = {"anti_windup": 10.0, "derivative_filter": 1e-4}
    tables |= {f"controller.{name}": {"start": s} for name, s in starts.items()}
    case = read(study({"parameters": tables, "tune": ["controller.*"]}))
    # those of the table first, then the others in the order of the fields
    names = [name for name, known in declarations(PID) if known.typical]
    assert set(case.space.paths) == {f"controller.{name}" for name in names}
    rest = [f"controller.{name}" for name in names]
    rest = [path for path in rest if path not in tables]
    assert case.space.paths == (*tables, *rest)
    assert case.space.ranges()["controller.derivative"].upper == 1e-3
    assert case.space.ranges()[INTEGRAL] == declared_range(INTEGRAL)
    assert float(get(case.loop, "controller.anti_windup")) == 10.0


def test_a_pattern_starts_a_parameter_of_zero_at_its_lower_bound(study):
    stock = {"type": "PID", "proportional": 1.0, "integral": 9.0, "dt": 5e-5}
    changes = {"controller": stock, "parameters": GONE, "tune": ["controller.*"]}
    case = read(study(changes))
    names = ("anti_windup", "derivative", "derivative_filter")
    off = [f"controller.{name}" for name in names]
    for path in off:
        lower = declared_range(path).lower
        assert float(get(case.loop, path)) == lower > 0.0
        assert any(
            n.startswith(f"{path} is 0") and f"{lower:g}" in n for n in case.notes
        )
    assert len(case.notes) == len(off)
    assert read(study({})).notes == ()


def test_a_pattern_widens_the_declared_range_to_the_start(study):
    stock = {"type": "PID", "proportional": 1.0, "integral": 9.0, "dt": 5e-5}
    stock |= {"derivative": 1e-12, "derivative_filter": 1e-4, "anti_windup": 10.0}
    changes = {"controller": stock, "parameters": GONE, "tune": ["controller.*"]}
    ranges = read(study(changes)).space.ranges()
    found = ranges["controller.derivative"]
    assert found.lower == pytest.approx(1e-13)
    assert found.upper == declared_range("controller.derivative").upper
    assert ranges[INTEGRAL] == declared_range(INTEGRAL)


def test_a_table_does_not_move_a_start_of_zero(refusal):
    message = refusal({"parameters": {"controller.derivative": {}}})
    assert message.startswith("controller.derivative starts at 0; its bounds")


def test_patterns_and_paths_name_a_parameter_once(study):
    case = read(
        study({"tune": ["controller.i*", INTEGRAL, "controller.*_weight"]}),
    )
    assert case.space.paths == (
        *(PROPORTIONAL, INTEGRAL),
        *("controller.proportional_weight", "controller.derivative_weight"),
    )
    assert case.space.upper[1] == 2e4


def observed(dt):
    """Return a PID with a disturbance observer, as a table."""
    return {
        "type": "DisturbanceObserverControl",
        "feedback": {"type": "PID", "proportional": 1.0, "integral": 9.0, "dt": dt},
        "model": {
            "type": "ARMA",
            "autoregressive": [0.9, -0.1],
            "moving": [0.1, 0.1, 0.0],
        },
        "gain": 0.2,
        "cutoff": 500.0,
        "dt": dt,
    }


def test_a_declared_range_ends_below_nyquist(study):
    changes = {"rate": 10_000.0, "plant/dt": 1e-4, "controller": observed(1e-4)}
    changes |= {"parameters": GONE, "tune": ["*.cutoff"]}
    (found,) = read(study(changes)).space.ranges().values()
    assert found.upper == pytest.approx(0.99 * np.pi * 1e4, rel=1e-12)
    declared = dict(declarations(DisturbanceObserverControl))["cutoff"]
    assert found.upper < declared.typical[1]


SERVO = {"proportional": 0.1, "integral": 10.0, "lower": 0.0, "upper": 100.0}
SERVO |= {"type": "Servo", "dt": 5e-5}
WIRES = {"sensor_gain": 0.1, "amplifier_gain": 15.0}
SWITCHED = {
    "notch_frequency_1": SERVO,
    "low_pass": SERVO,
    "filter_1": {
        **{"type": "PyRPL", "p": -0.1, "i": -10.0, "filter_1": 1e3, "dt": 5e-5},
        **WIRES,
    },
}


@pytest.mark.parametrize("name", SWITCHED)
def test_a_filter_that_is_off_is_searched_below_half_the_rate(study, refusal, name):
    changes = {"controller": SWITCHED[name], "parameters": GONE}
    path = f"controller.{name}"
    (found,) = read(study(changes | {"tune": [path]})).space.ranges().values()
    assert (found.lower, found.upper) == (10.0, pytest.approx(9900.0, rel=1e-12))
    controller = SWITCHED[name] | {name: 12e3}
    message = refusal(changes | {"controller": controller, "tune": [path]})
    assert message.startswith(f"{path} starts at 12000; its bounds 10 to 9900 must inc")
    message = refusal(changes | {"parameters": {path: {"upper": 24e3}}})
    assert message == (
        f"parameters.{path}.upper: {name} in Hz is 24000; it must be finite and above "
        "0 and below 10000"
    )


def test_a_pattern_takes_filters_that_are_off(study):
    device = {name: x for name, x in SWITCHED["filter_1"].items() if name != "filter_1"}
    case = read(study({"controller": device, "parameters": GONE, "tune": ["*"]}))
    assert case.space.ranges()["controller.filter_1"].upper == pytest.approx(9900.0)
    assert any("filter_1 is above half the sampling rate" in x for x in case.notes)


def test_a_factor_stays_within_the_limits_of_the_device(study):
    device = {"type": "E727", "proportional": 0.1, "integral_time": 1e-3, "scale": 2.0}
    device |= {"lower": 0.0, "upper": 100.0, "notch_frequency_1": 7e3}
    path = "controller.notch_frequency_1"
    changes = {"controller": device, "parameters": {path: {"within": 1.5}}}
    (found,) = read(study(changes)).space.ranges().values()
    assert found.upper == 9e3
    assert found.lower == pytest.approx(7e3 / 1.5)


@pytest.mark.parametrize(
    ("tune", "message"),
    [
        (
            ["controller.gain*"],
            "tune: controller.gain* has no match in the controller; name paths under "
            '[parameters], as in "controller.cutoff" = { lower = 100.0, upper = 2e4 }',
        ),
        (["plant.*"], "tune: plant.* has no match in the controller; name paths unde"),
        (
            ["plant.time_constant"],
            "tune: plant.time_constant: the path must start with 'controller.'",
        ),
        (["controller.gain"], "no parameter 'controller.gain'; the nearest are "),
        (
            ["controller.derivative"],
            "controller.derivative starts at 0; its bounds 1e-08 to 0.1 must include",
        ),
        ("controller.*", "tune is 'controller.*': Input should be a valid tuple"),
    ],
)
def test_names_that_cannot_be_tuned_are_refused(refusal, tune, message):
    assert refusal({"tune": tune}).startswith(message)


def test_a_parameter_without_a_declared_range_needs_bounds(refusal):
    named = {"controller": observed(5e-5), "parameters": GONE}
    path = "controller.model.moving.0"
    expected = (
        f"parameters.{path}.lower is missing; no range is declared for this parameter, "
        "so give it lower and upper"
    )
    assert refusal(named | {"tune": [path]}) == expected
    assert refusal(named | {"parameters": {path: {"upper": 9.0}}}) == expected
    message = refusal(named | {"tune": ["controller.model.*"]})
    assert message.startswith("tune: controller.model.* has no declared range; name")


def test_an_array_cannot_be_tuned(refusal):
    ones = {key: [[1.0]] for key in "ABCD"}
    law = {"type": "StateSpace", **ones, "dt": 5e-5}
    controller = {"type": "StateSpaceController", "law": law}
    tables = {"controller.law.A": {"lower": 0.0, "upper": 1.0}}
    assert refusal({"controller": controller, "parameters": tables}) == (
        "parameters.controller.law.A has shape (1, 1); it must be a number"
    )


def test_units_are_those_of_the_declarations(study):
    case = read(study({}))
    assert case.unit(PROPORTIONAL) == "V/um"
    assert case.unit("controller.nothing") == ""
    # On a stage with several axes lengths and commands are in units of the axis.
    axes = case.study.model_copy(update={"axes": "any"})
    assert replace(case, study=axes).unit(PROPORTIONAL) == ""
    assert replace(case, study=axes).unit("controller.anti_windup") == "1/s"


def test_converters_and_slew_limit(study):
    case = read(
        study(
            {
                "actuator/slew_rate": 1e4,
                "actuator/resolution": 0.01,
                "sensor/resolution": 0.001,
            }
        )
    )
    assert case.loop.actuator.names == ("limits", "slew", "converter")
    assert case.loop.sensor.names == ("noise", "converter")
    assert float(get(case.loop, "actuator.slew.rate")) == 1e4
    assert float(get(case.loop, "sensor.converter.resolution")) == 0.001


def test_paths_are_relative_to_the_study(study, tmp_path, monkeypatch):
    path = study({"plant": {"file": "plant.json"}, "controller": {"file": "c.toml"}})
    save(p753.plant(), path.parent / "plant.json")
    save(p753.pid(), path.parent / "c.toml")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert get(read(path).loop, "plant.hysteresis.a") == 0.0077


@pytest.mark.parametrize("where", ["plant", "controller"])
def test_an_unsafe_file_is_refused_unless_the_study_accepts_it(study, refusal, where):
    path = study({}).parent / "a.json"
    save({"plant": p753.plant, "controller": p753.pid}[where](), path, UNSAFE)
    assert refusal({where: {"file": "a.json"}}) == (
        f"{where}.file: a.json was written with an alarm: Ms 3 is above 2; "
        f"set {where}.accept_unsafe = true to use it anyway"
    )
    loop = read(study({where: {"file": "a.json", "accept_unsafe": True}})).loop
    assert get(loop, "actuator.limits.upper") == 120.0
    assert refusal({where: {"file": "a.json", "accept_unsafe": "yes"}}) == (
        f"{where}.accept_unsafe is 'yes'; it must be true or false"
    )


def test_a_design_for_the_plant_of_the_study(study):
    plant = {
        "type": "Series",
        "parts": [
            {"type": "ColemanHodgdon", "a": 0.0077, "b": 0.1167, "c": -0.0487},
            {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5},
        ],
    }
    changes = {
        "plant": plant,
        "controller": {"design": "disturbance_observer_sliding_mode"},
        "parameters": {"controller.cutoff": {"lower": 1.0, "upper": 2e4}},
    }
    case = read(study(changes))
    # The mean slope of the loading curve from 0 V: y = p x + s q (1 - exp(s c x)) on
    # the branch of direction s, with p = -a/c and q = (p - b)/c.
    a, b, c = 0.0077, 0.1167, -0.0487
    p, q = -a / c, (-a / c - b) / c
    top, bottom = (
        p * x + s * q * (1.0 - np.exp(s * c * x)) for s, x in ((1, 120.0), (-1, -20.0))
    )
    assert float(case.loop.controller.gain) == pytest.approx((top - bottom) / 140.0)


def test_a_cut_off_below_nyquist_is_accepted(study):
    changes = {
        "controller": {"catalog": "p753_disturbance_observer"},
        "parameters": {"controller.cutoff": {"lower": 1.0, "upper": 62_831.8}},
    }
    assert read(study(changes)).space.upper[0] == 62_831.8


# Errors


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (
            "rat",
            1.0,
            "rat is unknown; allowed are title, rate, seed, axes, plant, actuator, "
            "sensor, controller, references, tune, parameters, objective, optimiser, "
            "disturbance, ensemble, constraints, pareto, holdout_draws, beside, "
            "sweep, structures; did you mean 'rate'?",
        ),
        ("actuator/uper", 1.0, "actuator.uper is unknown; allowed are resolution, "),
        (
            "sensor/noise",
            0.1,
            "sensor.noise is unknown; allowed are resolution, bits, range, bandwidth, "
            "order, delay, noise_rms, measured_noise, anti_aliasing, "
            "anti_aliasing_order; did you mean 'noise_rms'?",
        ),
        (
            "references/setle",
            0.1,
            "references.setle is unknown; allowed are tune, unseen, amplitude, offset, "
            "duration, settle, files; did you mean 'settle'?",
        ),
        (
            "parameters/controller.integral/max",
            1.0,
            "parameters.controller.integral.max is unknown; allowed are lower, upper, "
            "scale, start",
        ),
        (
            "parameters/controller.integral/scael",
            "log",
            "parameters.controller.integral.scael is unknown; allowed are lower, "
            "upper, scale, start, within; did you mean 'scale'?",
        ),
        (
            "objective/effort",
            1.0,
            "objective.effort is unknown; allowed are aggregate, coupling_weight, ",
        ),
        (
            "optimiser/start",
            3,
            "optimiser.start is unknown; allowed are method, starts, candidates, "
            "steps, tolerance; did you mean 'starts'?",
        ),
        (
            "plant",
            {"record": "r.csv", "model": "coleman_hodgdon", "trian": [0, 9]},
            "plant.trian is unknown; allowed are record, model, method, among, time, "
            "input, output, record_rate, resample, period, train, validate, test, "
            "order, window, oversample, steps, check; did you mean 'train'?",
        ),
        (
            "controller",
            {"catalog": "p753_pid", "gain": 3.0},
            "controller has the keys catalog, gain; it must have exactly one of "
            "catalog, file, type, design",
        ),
        (
            "plant",
            {"type": "FirstOrderLag", "time_constnt": 1e-3, "dt": 5e-5},
            "plant.time_constnt is unknown; FirstOrderLag has time_constant, dt",
        ),
    ],
)
def test_unknown_keys(refusal, place, value, message):
    assert refusal({place: value}).startswith(message)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (
            "references/tune",
            ["SIN50", "SINE50"],
            "references.tune: signal 'SINE50' is unknown; it must be one of SIN, SW, "
            "PWSW, TRI, STEP, SQUARE, CONST, CHIRP, MULTISINE, PRBS, COS, SCAN, "
            "followed by",
        ),
        ("references/unseen", ["SIN5O"], "references.unseen: signal 'SIN5O' is unkn"),
        (
            "optimiser/method",
            "adam",
            "optimiser.method is 'adam': 'adam' is unknown; there are bfgs, "
            "levenberg_marquardt, lbfgsb",
        ),
        (
            "plant",
            {"catalog": "p754"},
            "plant.catalog: 'p754' is unknown; there are p753",
        ),
        (
            "controller",
            {"catalog": "pid"},
            "controller.catalog: 'pid' is unknown; there are p753_pid, "
            "p753_sliding_mode, p753_inversion, p753_preisach_inversion",
        ),
        (
            "controller",
            {"design": "lqr"},
            "controller.design: 'lqr' is unknown; there are inversion_sliding_mode, "
            "disturbance_observer_sliding_mode, inversion_pid",
        ),
        (
            "plant",
            {"record": "r.csv", "model": "preisac"},
            "plant.model is 'preisac': a model has no part 'preisac'; there are co",
        ),
        (
            "plant",
            {"type": "Lag", "time_constant": 1e-3},
            "plant.type is 'Lag'; it must be one of ARMA, ActiveDamping, A",
        ),
        (
            "plant",
            {"type": "os.system"},
            "plant.type is 'os.system'; it must be one of ARMA, ActiveDamping, A",
        ),
        (
            "parameters/controller.integral/scale",
            "sqrt",
            "parameters.controller.integral.scale is 'sqrt': Input should be "
            "'linear', 'log' or 'logit'",
        ),
        (
            "objective/aggregate",
            "sum",
            "objective.aggregate is 'sum': Input should be 'geometric_mean', "
            "'mean_square' or 'worst'",
        ),
    ],
)
def test_unknown_names(refusal, place, value, message):
    assert refusal({place: value}).startswith(message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"lower": 0.6},
            "controller.proportional starts at 0.5; its bounds 0.6 to 5 must include",
        ),
        (
            {"upper": 0.4},
            "controller.proportional starts at 0.5; its bounds 0.1 to 0.4 must includ",
        ),
        (
            {"start": 7.0},
            "controller.proportional starts at 7; its bounds 0.1 to 5 must include",
        ),
        (
            {"lower": 5.0, "upper": 0.1},
            "controller.proportional: bounds are 5 and 0.1; they must be finite and "
            "the lower below the upper",
        ),
        (
            {"upper": 0.1},
            "controller.proportional: bounds are 0.1 and 0.1; they must be finite",
        ),
        (
            {"lower": 0.0},
            "controller.proportional: the lower bound is 0; with scale 'log' it "
            "must be above 0",
        ),
        (
            {"lower": -1.0},
            "controller.proportional: the lower bound is -1; with scale 'log' it",
        ),
        (
            {"scale": "logit"},
            "controller.proportional: the bounds are 0.1 and 5; with scale "
            "'logit' they must lie between 0 and 1",
        ),
        (
            {"upper": float("inf")},
            "parameters.controller.proportional.upper is inf: Input should be a finit",
        ),
        (
            {"lower": float("nan")},
            "parameters.controller.proportional.lower is nan: Input should be a finit",
        ),
        (
            {"upper": "much"},
            "parameters.controller.proportional.upper is 'much': Input should be a va",
        ),
    ],
)
def test_bad_bounds(refusal, changes, message):
    path = "parameters/controller.proportional/"
    assert refusal({path + key: value for key, value in changes.items()}).startswith(
        message
    )


@pytest.mark.parametrize("upper", [20_000.0 * np.pi, 70_000.0])
def test_cut_off_beyond_nyquist(refusal, upper):
    changes = {
        "controller": {"catalog": "p753_disturbance_observer"},
        "parameters": {"controller.cutoff": {"lower": 100.0, "upper": upper}},
    }
    assert refusal(changes) == (
        f"parameters.controller.cutoff.upper: cutoff in rad/s is {upper:g}; "
        "it must be finite and above 0 and below 62831.9"
    )


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (
            "controller.proportionl",
            "no parameter 'controller.proportionl'; the nearest are "
            "controller.proportional",
        ),
        ("controller.dt", "no parameter 'controller.dt'; the nearest are controller."),
        (
            "controller.feedback.integral",
            "no parameter 'controller.feedback.integral'; the nearest are "
            "controller.integral",
        ),
        (
            "plant.time_constant",
            "parameters.plant.time_constant: the path must start with 'controller.'",
        ),
        ("integral", "parameters.integral: the path must start with 'controller.'"),
    ],
)
def test_paths_must_lead_to_a_parameter_of_the_controller(refusal, path, message):
    bounds = {"lower": 0.1, "upper": 5.0}
    assert refusal({f"parameters/{path}": bounds}).startswith(message)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("rate", -20_000.0, "rate is -20000.0: Input should be greater than 0"),
        ("rate", 0.0, "rate is 0.0: Input should be greater than 0"),
        ("rate", float("inf"), "rate is inf: Input should be a finite number"),
        ("seed", -1, "seed is -1: Input should be greater than or equal to 0"),
        ("holdout_draws", 0, "holdout_draws is 0: Input should be greater than or eq"),
        ("actuator/slew_rate", -1.0, "actuator.slew_rate is -1.0: Input should be gre"),
        ("actuator/resolution", 0.0, "actuator.resolution is 0.0: Input should be gr"),
        ("sensor/noise_rms", -0.01, "sensor.noise_rms is -0.01: Input should be great"),
        ("sensor/noise_rms", float("nan"), "sensor.noise_rms is nan: Input should be"),
        ("references/amplitude", 0.0, "references.amplitude is 0.0: Input should be"),
        ("references/offset", float("inf"), "references.offset is inf: Input should "),
        ("references/duration", -1.0, "references.duration is -1.0: Input should be "),
        ("references/settle", -0.1, "references.settle is -0.1: Input should be great"),
        ("references/tune", [], "references.tune: Tuple should have at least 1 item"),
        ("objective/effort_weight", -1.0, "objective.effort_weight is -1.0: Input sh"),
        ("objective/noise_draws", 0, "objective.noise_draws is 0: Input should be gr"),
        ("optimiser/starts", 0, "optimiser.starts is 0: Input should be greater than"),
        ("optimiser/steps", 0, "optimiser.steps is 0: Input should be greater than or"),
        ("optimiser/candidates", -1, "optimiser.candidates is -1: Input should be gr"),
        ("optimiser/tolerance", 0.0, "optimiser.tolerance is 0.0: Input should be gr"),
        ("parameters", {}, "tune and parameters are missing; name at least one param"),
    ],
)
def test_values_out_of_range(refusal, place, value, message):
    assert refusal({place: value}).startswith(message)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("title", 3, "title is 3: Input should be a valid string"),
        ("rate", "fast", "rate is 'fast': Input should be a valid number"),
        ("seed", 3.5, "seed is 3.5: Input should be a valid integer"),
        ("actuator", 120.0, "actuator is 120.0: Input should be a valid dictionary"),
        ("actuator/lower", "low", "actuator.lower is 'low': Input should be a valid n"),
        ("plant", "p753", "plant is 'p753': Input should be a valid dictionary"),
        ("references/tune", "SIN50", "references.tune is 'SIN50': Input should be a "),
        ("references/tune", [50], "references.tune.0 is 50: Input should be a valid s"),
        ("optimiser/method", 3, "optimiser.method is 3: Input should be a valid strin"),
        ("optimiser/steps", "many", "optimiser.steps is 'many': Input should be a va"),
        ("optimiser/starts", 2.5, "optimiser.starts is 2.5: Input should be a valid "),
        (
            "parameters/controller.integral",
            [100.0, 2e4],
            "parameters.controller.integral: Input should be a valid dictionary",
        ),
    ],
)
def test_values_of_another_type(refusal, place, value, message):
    assert refusal({place: value}).startswith(message)


@pytest.mark.parametrize(
    "place",
    [
        *("title", "rate", "plant", "actuator", "controller", "references"),
        *("actuator/lower", "actuator/upper", "references/tune"),
    ],
)
def test_missing_entries_are_refused(refusal, place):
    assert refusal({place: GONE}) == f"{place.replace('/', '.')} is missing"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 5000 + "]" * 5000, "nests tables or lists more than 64 deep"),
        (f"[{'.'.join(['a'] * 2000)}]", "nests tables or lists more than 64 deep"),
        ("rate = 1" + "0" * 400, "rate is 1000000"),
        ("rate = 1" + "0" * 9000, "Exceeds the limit"),
    ],
)
@pytest.mark.parametrize("reader", [load, load_comparison_study])
def test_a_file_without_a_study_is_refused(tmp_path, text, message, reader):
    path = tmp_path / "stage.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        reader(path)
    assert str(caught.value).startswith(f"study {path}")
    assert "\n" not in str(caught.value)
    assert not is_comparison_study(path)


def test_more_samples_than_the_memory_are_refused(refusal, study):
    # 3 references of 1 + 2 * 2 signals of 8 bytes: 1.2e-7 GB a sample.
    assert refusal({"references/duration": 1e4}) == (
        "references.duration is 10000 s: at 20000 Hz the signals of all references "
        "have 2e+08 samples each and take 24 GB; the limit is 4 GB"
    )
    assert "inf samples" in refusal({"references/duration": 1e308})
    assert load(study({"references/duration": 1.6e3})).references.duration == 1.6e3


def test_as_many_samples_as_the_memory_are_accepted(study, monkeypatch):
    # 2000 samples of 15 signals of 8 bytes, in GB.
    monkeypatch.setattr("piezojax.study.schema.MEMORY_GB", 0.1 * 20_000 * 15 * 8e-9)
    assert load(study({"references/duration": 0.1})).references.duration == 0.1


def test_references_last_a_second_by_default(study):
    table = load(study({"references/duration": GONE})).references
    assert table.duration == 1.0


def test_a_reference_at_half_the_rate(refusal):
    message = refusal({"references/unseen": ["SIN10000"]})
    assert message == (
        "references: the frequency of SIN10000 is not below half the rate, 10000 Hz"
    )


def test_a_reference_at_half_the_rate_beside_a_recorded_one(refusal, tmp_path):
    (tmp_path / "scan.csv").write_text("z\n" + "1.0\n2.0\n" * 1000)
    recorded = {"files": {"scan": {"file": "scan.csv", "rate": 2e4}}}
    names = {"tune": ["scan", "SIN50"], "unseen": ["SIN10000"]}
    message = refusal({f"references/{k}": v for k, v in (recorded | names).items()})
    assert "the frequency of SIN10000 is not below half the rate" in message


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (
            {"design": "nv200", "scal": 1.0},
            "nv200 has no setting 'scal'; its settings are scale, slew, range",
        ),
        (
            {"design": "inversion_pid", "scale": 1.0},
            "inversion_pid has no setting 'scale'; it has none",
        ),
        ({"design": "e727"}, "e727 needs the setting 'scale'"),
        (
            {"design": "nv200", "scale": "big"},
            "the setting 'scale' is 'big': Input should be a valid number",
        ),
        ({"design": "nv200", "range": [1.0]}, "the setting 'range' is [1.0]: "),
        ({"design": "nv201"}, "'nv201' is unknown; there are inversion_sliding"),
    ],
)
def test_settings_of_designs(refusal, controller, message):
    found = refusal({"controller": controller, "parameters": GONE, "tune": ["x"]})
    assert found.startswith("controller.design: ")
    assert message in found


def test_a_parameter_within_a_factor_of_its_start(study):
    path = "controller.integral"
    start = float(read(study({})).loop.controller.integral)

    def bounds(table):
        found = read(study({"parameters": {path: table}})).space.ranges()[path]
        return found.lower, found.upper

    assert bounds({"within": 3.0}) == pytest.approx((start / 3.0, 3.0 * start))
    assert bounds({"within": 2.0, "start": 8.0}) == pytest.approx((4.0, 16.0))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"within": 1.0}, "within is 1.0: Input should be greater than 1"),
        ({"within": 2.0, "upper": 9.0}, "within stands for lower and upper"),
        ({"within": 2.0, "start": 0.0}, "within needs a start above 0; the start is 0"),
    ],
)
def test_bad_factors(refusal, table, message):
    found = refusal({"parameters": {"controller.integral": table}})
    assert message in found


def test_a_front_has_at_least_two_limits(study, refusal):
    front = {"constraint": "effort", "limits": [20.0, 30.0]}
    limit = {"constraints": {"effort": 30.0}}
    assert load(study(limit | {"pareto": front})).pareto.limits == (20.0, 30.0)
    assert "pareto.limits" in refusal(limit | {"pareto": front | {"limits": [20.0]}})


@pytest.mark.parametrize("name", ["rise_time", "settling_time"])
def test_a_limit_beyond_the_run_of_a_step_is_refused(study, refusal, name):
    # No run of 0.05 s shows that a step takes at most 0.06 s.
    assert load(study({"constraints": {name: 0.04}})).limits[name] == 0.04
    message = f"is 0.06 s for the {name}; a step is simulated for 0.04995 s only"
    assert message in refusal({"constraints": {name: 0.06}})
    front = {"constraint": name, "limits": [0.02, 0.06]}
    assert message in refusal({"constraints": {name: 0.04}, "pareto": front})


@pytest.mark.parametrize("settle", [0.05, 0.06])
def test_settling_for_the_whole_run(refusal, settle):
    message = f"settle is {settle:g} s; it must be below the duration, 0.05 s"
    assert message in refusal({"references/settle": settle})


def test_a_reference_that_is_tuned_on_is_not_unseen(refusal):
    message = refusal({"references/unseen": ["TRI50", "SW50"]})
    assert message == "references: SW50 is in both tune and unseen"


@pytest.mark.parametrize(
    "rate",
    [
        10_000.0,
        20_010.0,
        20_001.0,
    ],
)
def test_a_controller_made_for_another_rate(refusal, rate):
    static = {"type": "ARMA", "autoregressive": [0.5], "moving": [0.0, 0.067]}
    assert refusal({"rate": rate, "plant": static}) == (
        f"rate is {rate:g} Hz, but the controller or plant was made for 20000 Hz"
    )


@pytest.mark.parametrize(("error", "accepted"), [(5e-10, True), (2e-9, False)])
def test_a_sample_time_may_be_rounded_to_nine_digits(study, refusal, error, accepted):
    lag = {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5 * (1.0 + error)}
    if accepted:
        assert read(study({"plant": lag})).loop.plant.dt == lag["dt"]
    else:
        assert "was made for 20000 Hz" in refusal({"plant": lag})


def test_a_plant_made_for_another_rate(refusal):
    message = refusal({"plant/dt": 1e-3})
    assert message.startswith("rate is 20000 Hz, but the controller or plant was made ")
    assert "1000 Hz" in message


@pytest.mark.parametrize("method", ["geometric_mean", "worst"])
def test_least_squares_needs_a_squared_objective(refusal, method):
    message = refusal(
        {"optimiser/method": "levenberg_marquardt", "objective/aggregate": method}
    )
    assert (
        "optimiser.method levenberg_marquardt minimises squares; objective.aggregate "
        f"is '{method}', it must be 'mean_square'" in message
    )


def test_least_squares_needs_the_mean_over_the_plants(study, refusal):
    worst = {"ensemble/spread": {"gain": 0.1}, "ensemble/aggregate": "worst"}
    squares = {
        "optimiser/method": "levenberg_marquardt",
        "objective/aggregate": "mean_square",
    }
    assert (
        "optimiser.method levenberg_marquardt minimises squares; ensemble.aggregate "
        "is 'worst', it must be 'mean'" in refusal(worst | squares)
    )
    assert load(study(worst)).ensemble.aggregate == "worst"
    assert load(study(squares | {"ensemble/spread": {"gain": 0.1}}))


def test_a_sweep_is_over_references_of_the_study(study, refusal):
    drawn = {"sweep/method": "latin_hypercube", "sweep/samples": 8}
    known = drawn | {"sweep/references": ["TRI50", "SW50"]}
    assert [*load(study(known)).sweep.references] == ["TRI50", "SW50"]
    assert (
        "sweep.references: SIN7 is not one of the study's references, SIN50, SW50, "
        "TRI50" in refusal(drawn | {"sweep/references": ["SW50", "SIN7"]})
    )


@pytest.mark.parametrize("where", ["plant", "controller"])
@pytest.mark.parametrize(
    ("table", "keys"),
    [
        ({}, "none"),
        ({"name": "p753"}, "name"),
        ({"catalog": "p753_pid", "file": "a.json"}, "catalog, file"),
        ({"catalog": "p753", "type": "Affine"}, "catalog, type"),
    ],
)
def test_exactly_one_choice_is_required(refusal, where, table, keys):
    last = "record, response" if where == "plant" else "design"
    assert refusal({where: table}) == (
        f"{where} has the keys {keys}; it must have exactly one of "
        f"catalog, file, type, {last}"
    )


def test_limits_of_the_actuator(refusal):
    message = refusal({"actuator/lower": 130.0})
    assert message == (
        "actuator: lower is 130 V and upper 120 V; lower must be below upper"
    )


def test_a_bad_plant_names_its_table(refusal):
    assert refusal({"plant/time_constant": -1.0}) == (
        "plant: time_constant in s is -1; it must be finite and above 0"
    )


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        ({"file": "no.json"}, "plant.file: .*no.json: No such file or directory"),
        ({"file": "no.yaml"}, "plant.file: .*no.yaml: the name must end in .toml or"),
        (
            {"record": "no.csv", "model": "coleman_hodgdon"},
            "record .*no.csv: No such file or directory",
        ),
        ({"record": "no.csv"}, "record .*no.csv: No such file or directory"),
        (
            {"record": "no.csv", "model": "coleman_hodgdon", "record_rate": -1.0},
            "plant.record_rate is -1.0: Input should be greater than 0",
        ),
    ],
)
def test_files_that_are_missing(refusal, plant, message):
    assert re.match(message, refusal({"plant": plant}))


def test_a_record_without_time_or_rate(study, refusal):
    place = study({}).parent
    (place / "r.csv").write_text("u,y\n" + "".join(f"{i},{i}\n" for i in range(60)))
    message = refusal({"plant": {"record": "r.csv", "model": "coleman_hodgdon"}})
    assert message == "r.csv: name the time column, or give its rate in Hz"


def test_a_design_that_does_not_fit_the_plant(refusal):
    falls = {"type": "ColemanHodgdon", "a": 0.0077, "b": 0.01, "c": -0.0487}
    message = refusal({"plant": falls, "controller": {"design": "inversion_pid"}})
    assert message.startswith(
        "controller.design: no inverse of the hysteresis from -20 to 120 V: between "
    )
    integrator = {"type": "ARMA", "autoregressive": [1.0], "moving": [0.1]}
    assert refusal(
        {"plant": integrator, "controller": {"design": "inversion_pid"}}
    ) == (
        "controller.design: the plant has a pole of modulus 1; a design needs a plant "
        "that comes to rest, with all poles below 1"
    )


def test_a_controller_contains_a_design(study, refusal):
    limited = {"type": "LimitedReference", "slew": 1e3, "dt": 5e-5}
    designed = {
        "controller": limited | {"controller": {"design": "inversion_pid"}},
        "parameters": GONE,
        "tune": ["controller.controller.feedback.*"],
    }
    case = read(study(designed))
    alone = designed | {
        "controller": {"design": "inversion_pid"},
        "tune": ["controller.feedback.*"],
    }
    assert to_data(case.loop.controller) == limited | {
        "acceleration": 1e12,  # the default is no limit
        "controller": to_data(read(study(alone)).loop.controller),
    }
    of_catalog = {"controller": limited | {"controller": {"catalog": "p753_pid"}}}
    known = read(study(designed | of_catalog | {"tune": ["controller.controller.*"]}))
    assert type(known.loop.controller.controller).__name__ == "PID"
    for part, message in (
        ({"design": "lqr"}, "controller.controller.design: 'lqr' is unknown"),
        ({"design": "lqr", "catalog": "a"}, "controller.controller has the keys"),
        (
            {"catalog": "p753_pd"},
            "controller.controller.catalog: 'p753_pd' is unknown",
        ),
    ):
        assert refusal({"controller": limited | {"controller": part}}).startswith(
            message
        )


@pytest.fixture
def study_of_a_bent_plant(study, monkeypatch):
    """Return a study of a plant whose output rises up to 110 V only."""
    bent = ShapedColemanHodgdon((0.0, 0.0077, -4e-5), (0.3,), -0.0487)

    def written(highest):
        path = study(
            {
                "plant": {"record": "r.csv", "time": "t", "input": "u", "output": "y"},
                "controller": {"design": "inversion_pid"},
                "parameters": GONE,
                "tune": ["controller.feedback.*"],
            }
        )
        rows = [f"{i / 20_000},{i * highest / 99},{i}" for i in range(100)]
        (path.parent / "r.csv").write_text("\n".join(["t,u,y", *rows]))
        return path

    monkeypatch.setattr(
        "piezojax.study.fitted_plant.identify",
        lambda records, *_, **__: fit_of(bent, records[0], records[0].output),
    )
    return written


def test_a_design_keeps_to_the_record_if_the_model_falls_outside(
    study_of_a_bent_plant,
):
    case = read(study_of_a_bent_plant(80.0))
    inverse = case.loop.controller.inverse
    assert (float(inverse.lower), float(inverse.upper)) == (0.0, 80.0)
    assert re.fullmatch(
        r"controller\.design: no inverse of the hysteresis from -20 to 120 V: .* over "
        "its record, 0 to 80 V: the voltage stays between these",
        case.notes[0],
    )


def test_a_design_is_refused_if_the_model_falls_within_the_record(
    study_of_a_bent_plant,
):
    message = (
        r"controller\.design: no inverse of the hysteresis from -20 to 120 V: .* none "
        "over its record either, 0 to 120 V: record several cycles"
    )
    with pytest.raises(ValueError, match=message):
        read(study_of_a_bent_plant(120.0))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"title = = 3", "is not a TOML file: Invalid value (at line 1, column 9)"),
        (bytes(range(256)), "is not a TOML file"),
        (b"", "title is missing"),
    ],
)
def test_files_without_a_study_are_refused(tmp_path, content, message):
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(message)):
        load(path)


def test_unknown_studies_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"study .*a.toml: No such file or directory"):
        load(tmp_path / "a.toml")
    with pytest.raises(ValueError, match=r"study .*: Is a directory"):
        load(tmp_path)
    with pytest.raises(ValueError, match="study 'p754' is unknown; there are ") as got:
        shipped("p754")
    assert str(got.value).endswith(", ".join(SHIPPED))


# Messages of a run without type checks, in a separate process, because these tests
# check all types and a run of a user does not.


DOB = {"controller": {"catalog": "p753_disturbance_observer"}}
FEEDBACK = "controller.feedback."
UNSAID = {
    "two limits the wrong way round": ({"actuator/lower": 130.0}, "actuator"),
    "a list for a name": ({"controller": {"catalog": ["p753_pid"]}}, "controller"),
    "a list for a type": ({"plant": {"type": ["Affine"]}}, "plant.type"),
    "one reference twice": ({"references/tune": ["SW50", "SW50"]}, "SW50"),
    "a window without a sample": ({"references/settle": 0.04999}, "settle"),
    "a reference beyond Nyquist": ({"references/tune": ["SIN15000"]}, "SIN15000"),
    "a run without a sample": (
        {"references/duration": 1e-5, "references/settle": 0.0},
        "duration",
    ),
    "a record and a catalog": (
        {"plant": {"catalog": "p753", "record": "r.csv"}},
        "exactly one of",
    ),
    "a path without quotes": (
        {"parameters": {"controller": {"integral": {"lower": 1.0, "upper": 9.0}}}},
        "quot",
    ),
    "alpha beyond 1": (
        DOB | {"parameters": {FEEDBACK + "filter.alpha": {"lower": 0.01, "upper": 7}}},
        "filter.alpha",
    ),
    "a negative cut-off": (
        DOB | {"parameters": {"controller.cutoff": {"lower": -100.0, "upper": 900.0}}},
        "cutoff",
    ),
    "a negative weight to start from": (
        DOB
        | {
            "parameters": {
                FEEDBACK + "control_weight": {"lower": -9, "upper": 200.0, "start": -1}
            }
        },
        "control_weight",
    ),
    "a controller for a plant": (
        {"plant": {"type": "PID", "proportional": 1.0, "integral": 1.0, "dt": 5e-5}},
        "plant",
    ),
    "a rate of true": ({"rate": True}, "rate is True"),
    "a rate as text": ({"rate": "20000"}, "rate is '20000'"),
    "a colon without a key": (
        {"optimiser/method": "levenberg_marquardt"},
        "optimiser.method",
    ),
}
SCRIPT = """
import json, sys
from piezojax.study import read
for path in sys.argv[1:]:
    try:
        read(path)
        print(json.dumps(["built", ""]))
    except Exception as error:
        print(json.dumps([type(error).__name__, str(error)]))
"""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studies")
    paths = []
    for i, (changes, _) in enumerate(UNSAID.values()):
        path = folder / f"{i}.toml"
        path.write_text(tomli_w.dumps(with_values(BASE, changes)), encoding="utf-8")
        paths.append(str(path))
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *paths],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = map(json.loads, done.stdout.splitlines())
    return dict(zip(UNSAID, lines, strict=True))


@pytest.mark.parametrize("name", UNSAID)
def test_messages_without_type_checks(outcomes, name):
    kind, message = outcomes[name]
    assert kind == "ValueError"
    assert UNSAID[name][1] in message
    assert not message.startswith(":")


def test_shipped_accepts_a_name_and_no_path():
    with pytest.raises(ValueError, match="is unknown; there are "):
        shipped("../pyproject")


@pytest.mark.parametrize(
    ("start", "lower", "upper"),
    [(5.0, 1.0, 10.0), (200.0, 1.0, 2000.0), (0.01, 0.001, 10.0), (-1.0, 1.0, 10.0)],
)
def test_declared_bounds_reach_a_decade_beyond_a_start_outside(start, lower, upper):
    found = _reaching(Range(1.0, 10.0, "log"), start)
    assert (found.lower, found.upper) == pytest.approx((lower, upper))
    assert _reaching(Range(1.0, 10.0), start) == Range(1.0, 10.0)


def test_half_a_second_settles_by_default(study):
    changes = {"references/settle": GONE, "references/duration": 1.0}
    assert load(study(changes)).references.settle == 0.5
