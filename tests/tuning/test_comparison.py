"""Comparison of several studies: rows, files and refused input."""

import json
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner

from piezojax.catalog import p753_chapter4
from piezojax.cli.tune import main
from piezojax.core.paths import get
from piezojax.hysteresis import InverseColemanHodgdon, InversePreisach, Preisach
from piezojax.report.comparison_map import (
    comparison_figure,
    comparison_table,
    perturbed_table,
    perturbed_text,
)
from piezojax.study import (
    ComparisonStudy,
    compared_cases,
    load_comparison_study,
    read_compared,
    shipped,
)
from piezojax.tuning import compare, load_result
from piezojax.tuning import comparison as comparing
from piezojax.tuning.comparison import ComparisonResult

# An ARMA has no sample time, so any rate is allowed.
LAG = {"type": "ARMA", "autoregressive": [0.5], "moving": [0.0, 0.067]}
FILE = {
    "title": "two controllers",
    "rates": [5000.0, 10_000.0],
    "seed": 3,
    "plant": LAG,
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.012},
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "references": {
        "tune": ["SIN50"],
        "unseen": ["SW50"],
        "duration": 0.03,
        "settle": 0.01,
    },
    "optimiser": {"starts": 1, "candidates": 2, "steps": 2},
    "bounds": {"*": {"factor": 10.0}, "*.integral": {"factor": 30.0}},
    "controllers": {
        "pid": {
            "label": "PID",
            "catalog": "p753_ziegler_nichols",
            "elsewhere": "rule",
            "tune": ["controller.proportional", "controller.integral"],
        },
        "continuous": {
            "catalog": "p753_continuous",
            "printed": [5000.0],
            "rates": [5000.0],
            "tune": ["controller.law.integral", "controller.surface"],
            "bounds": {"*.surface": {"lower": 0.1, "upper": 5.0, "per_sample": True}},
        },
    },
}
NOISE = "sensor.noise.noise_rms"
ENSEMBLE = {"tune": 0, "margins": 0, "holdout": 3, "spread": {NOISE: 0.3}}
KEYS = {
    *("title", "status", "rows", "better", "unseen_better", "best"),
    *("best_perturbed", "versions", "seed", "wall_s"),
}


def entries(file):
    return compared_cases(file, "both.toml")


def hopeless(case, progress):
    raise ValueError("the loop diverges everywhere")


def file_with(**tables):
    return ComparisonStudy.model_validate(FILE | tables)


def with_controller(**changes):
    return file_with(controllers={"pid": FILE["controllers"]["pid"] | changes})


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    path = folder / "both.toml"
    file = FILE | {"rates": [5000.0], "ensemble": ENSEMBLE}
    path.write_text(tomli_w.dumps(file), encoding="utf-8")
    done = CliRunner().invoke(main, [str(path), "--out", str(folder / "out")])
    assert done.exit_code == 0, done.output
    assert done.stderr == ""
    text = (folder / "out" / "comparison.json").read_text(encoding="utf-8")
    return done.stdout, folder / "out", json.loads(text)


def test_a_row_for_each_controller_and_rate(compared):
    _, _, data = compared
    assert set(data) == KEYS
    assert data["status"] == "complete"
    found = [(row["controller"], row["rate_Hz"], row["start"]) for row in data["rows"]]
    assert found == [
        ("PID", 5000.0, "rule"),
        ("continuous", 5000.0, "printed"),
    ]


def test_rows_equal_the_results_of_the_studies(compared):
    _, out, data = compared
    assert {entry.name for entry in out.iterdir()} == {
        *("comparison.json", "comparison.png", "report.html"),
        *(row["study"] for row in data["rows"]),
    }
    for row in data["rows"]:
        result = load_result(out / row["study"])
        assert row["before_um"] == result.holdout_before.geomean_rms_um
        assert row["after_um"] == result.holdout.geomean_rms_um
        assert row["unseen_um"] == result.unseen.geomean_rms_um
        assert row["status"] == result.status
        assert row["tuned"] == 2
        assert result.perturbed is not None
        assert row["perturbed"] == result.perturbed.model_dump()
        assert row["perturbed"]["plants"] == 3
        assert (out / row["study"] / "gains.toml").exists()


def with_errors(result, before, after):
    def scores(error):
        return result.holdout.model_copy(update={"geomean_rms_um": error})

    return result.model_copy(
        update={"holdout_before": scores(before), "holdout": scores(after)}
    )


def tuned_to(monkeypatch, result, errors):
    """Replace tuning: it returns the given errors (um) before and after, in turn."""
    results = iter([with_errors(result, *pair) for pair in errors])
    monkeypatch.setattr(
        comparing,
        "tune",
        lambda case, progress: SimpleNamespace(result=next(results), case=case),
    )


def test_means_and_winners_follow_from_the_rows(compared, monkeypatch):
    _, out, data = compared
    result = load_result(out / data["rows"][0]["study"])
    # PID at 5 and 10 kHz, then the continuous one at 5 kHz.
    tuned_to(monkeypatch, result, [(0.8, 0.1), (0.6, 0.3), (0.5, 0.05)])
    comparison = compare("made up", entries(file_with()))
    assert comparison.better["PID"] == pytest.approx(4.0, rel=1e-12)
    assert comparison.better["continuous"] == pytest.approx(10.0, rel=1e-12)
    assert comparison.best == {"5000": "continuous", "10000": "PID"}


def test_a_start_that_diverges_has_no_ratio(compared, monkeypatch):
    _, out, data = compared
    result = load_result(out / data["rows"][0]["study"])
    tuned_to(monkeypatch, result, [(None, 0.1), (0.6, 0.3), (0.5, None)])
    comparison = compare("made up", entries(file_with()))
    assert [row.ratio for row in comparison.rows] == [None, 2.0, None]
    assert comparison.better == {"PID": None, "continuous": None}
    assert comparison.best["5000"] == "PID"


def perturbed_to(result, error, unstable=0, before=(0.4, None, 0.2)):
    changes = {
        "geomean_rms_um": error,
        "unstable": unstable,
        "unstable_before": before.count(None),
        "geomeans_before_um": before,
    }
    perturbed = result.perturbed.model_copy(update=changes)
    return result.model_copy(update={"perturbed": perturbed})


def test_the_best_on_held_out_plants_is_stable_on_all_plants(compared, monkeypatch):
    _, out, data = compared
    result = load_result(out / data["rows"][0]["study"])
    stable = perturbed_to(result, 0.03, before=(0.4, 0.2, 0.3))
    # PID at 5 and 10 kHz, then the continuous one at 5 kHz.
    results = iter([perturbed_to(result, 0.01, unstable=1), stable, stable])
    monkeypatch.setattr(
        comparing,
        "tune",
        lambda case, progress: SimpleNamespace(result=next(results), case=case),
    )
    comparison = compare("made up", entries(file_with()))
    assert comparison.best_perturbed == {"5000": "continuous", "10000": "PID"}
    before = [row.perturbed.geomean_before_rms_um for row in comparison.rows]
    assert before == [None, 0.3, 0.3]
    assert perturbed_text(comparison).splitlines() == [
        "lowest on held-out plants at 5 kHz: continuous",
        "lowest on held-out plants at 10 kHz: PID",
    ]
    worse = perturbed_to(result, 0.06).perturbed
    first = comparison.rows[0].model_copy(update={"perturbed": worse})
    rows = [first, *comparison.rows[1:]]
    text = perturbed_text(comparison.model_copy(update={"rows": rows}))
    assert "5 kHz: continuous; the next, PID, has 2.00 times its error" in text


def test_the_studies_of_a_comparison_can_be_tuned_separately(compared):
    _, out, data = compared
    study = out / data["rows"][0]["study"] / "study.toml"
    (entry,) = read_compared([study])[1]
    assert entry.case.study.rate == 5000.0
    assert tomllib.loads(study.read_text())["controller"] == {
        "catalog": "p753_ziegler_nichols"
    }


def test_the_command_ends_with_the_table(compared):
    printed, out, _ = compared
    assert "2 of 2: continuous at 5 kHz" in printed
    assert "rms tracking error on held-out noise, nm" in printed
    assert "held-out perturbed plants" in printed
    assert "lowest on held-out plants at 5 kHz: " in printed
    assert "geometric mean" in printed
    assert "complete: 2 of 2 studies" in printed
    assert (out / "comparison.png").read_bytes().startswith(b"\x89PNG")


def test_studies_of_one_rate_have_a_line_each_in_the_picture(compared):
    _, _, data = compared
    comparison = ComparisonResult.model_validate(data)
    first = comparison.rows[0].model_copy(update={"rate_Hz": 5e3, "alarms": []})
    rows = [
        first.model_copy(update={"study": "a", "before_um": 4.0, "after_um": 0.2}),
        first.model_copy(update={"study": "b", "before_um": None, "alarms": ["rings"]}),
    ]
    (ax,) = comparison_figure(comparison.model_copy(update={"rows": rows})).axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["a", "b!"]
    before, tuned, _ = ax.get_lines()[-3:]
    assert [list(each) for each in before.get_data()] == [[4e3], [0]]
    assert tuned.get_xdata()[0] == pytest.approx(200.0)
    assert ax.get_xlabel() == "rms error on held-out noise (nm)"


def test_several_studies_are_compared(compared, tmp_path, monkeypatch):
    _, out, data = compared
    paths = []
    for row in data["rows"]:
        paths.append(tmp_path / f"{row['controller']}.toml")
        paths[-1].write_text((out / row["study"] / "study.toml").read_text())
    monkeypatch.setattr(comparing, "tune", hopeless)
    done = CliRunner().invoke(main, [*map(str, paths), "--out", str(tmp_path / "out")])
    assert done.exit_code == 3, done.output
    comparison = ComparisonResult.model_validate_json(
        (tmp_path / "out" / "comparison.json").read_text(encoding="utf-8")
    )
    assert [row.study for row in comparison.rows] == ["PID", "continuous"]
    assert [row.start for row in comparison.rows] == ["own", "own"]
    assert "ALARM: PID: the loop diverges everywhere" in done.stdout


def test_two_studies_of_one_name_are_refused(compared, tmp_path):
    _, out, data = compared
    path = out / data["rows"][0]["study"] / "study.toml"
    with pytest.raises(ValueError, match="two studies are named study"):
        read_compared([path, path])


def test_bounds_by_factor_and_by_sample():
    pid, _, continuous = entries(file_with())
    start = float(get(pid.case.loop, "controller.integral"))
    bounds = pid.case.study.parameters["controller.integral"]
    np.testing.assert_allclose([bounds.lower, bounds.upper], [start / 30, start * 30])
    bounds = continuous.case.study.parameters["controller.surface"]
    assert (bounds.lower, bounds.upper) == (500.0, 25_000.0)


def test_bounds_are_widened_to_the_start():
    narrow = {"controller.proportional": {"lower": 1e-6, "upper": 1e-5}}
    (entry, _) = entries(with_controller(bounds=narrow))
    bounds = entry.case.study.parameters["controller.proportional"]
    assert bounds.lower == 1e-6
    assert bounds.upper == float(get(entry.case.loop, "controller.proportional"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"catalog": "p753_pdi"}, "pid at 5000 Hz: 'p753_pdi' is unknown; there are "),
        ({"rates": [3000.0]}, "pid at 3000 Hz: rate in Hz is 3000; it must be one of"),
        ({"tune": ["gain"]}, "pid at 5000 Hz: no parameter 'gain'; the nearest are"),
        (
            {"tune": ["controller.derivative"]},
            "derivative starts at 0; a factor needs a start ab",
        ),
    ],
)
def test_bad_controllers(changes, message):
    with pytest.raises(ValueError, match=message):
        entries(with_controller(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rates": [1e3, 1e3]}, "rates: 1000 Hz is listed twice"),
        (
            {"controllers": {"pid": FILE["controllers"]["pid"] | {"rates": [2e3] * 2}}},
            "controllers.pid.rates: 2000 Hz is listed twice",
        ),
        ({"bounds": {"integral": {"lower": 1.0}}}, "lower and upper, or a factor"),
        (
            {"bounds": {"*": {"factor": 9.0, "scale": "linear"}}},
            "scale is 'linear'; bounds of a factor are searched on the scale 'log'",
        ),
        (
            {"bounds": {"*": {"factor": 9.0, "per_sample": True}}},
            "a factor has no unit: leave per_sample out",
        ),
        ({"controllers": {"pid": {"label": "PID"}}}, "controllers.pid.catalog is miss"),
        (
            {"controllers": {"pid": {**FILE["controllers"]["pid"], "catalogue": "x"}}},
            "controllers.pid.catalogue is unknown; allowed are catalog, tune, label",
        ),
    ],
)
def test_bad_files_in_one_line(changes, message, tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(tomli_w.dumps(FILE | changes), encoding="utf-8")
    done = CliRunner().invoke(main, [str(path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_study_that_cannot_be_tuned_is_a_row(monkeypatch):
    monkeypatch.setattr(comparing, "tune", hopeless)
    comparison = compare("none", entries(file_with()))
    assert {row.status for row in comparison.rows} == {"failed"}
    assert comparison.rows[0].alarms == ["the loop diverges everywhere"]
    assert comparison.better == {"PID": None, "continuous": None}
    assert comparison.best == {}
    assert comparison_table(comparison).row_count > 0
    assert perturbed_table(comparison) is None


def test_the_inverses_are_compared_on_the_stage_with_preisach_hysteresis():
    comparison = load_comparison_study(shipped("comparison/p753_inverses"))
    cases = [e.case for e in compared_cases(comparison, "p753_inverses.toml")]
    inverses = [getattr(case.loop.controller, "inverse", None) for case in cases]
    kinds = [InversePreisach, InverseColemanHodgdon, type(None)]
    assert [type(inverse) for inverse in inverses] == kinds
    # The inverse has the density of the stage on another grid.
    stage = cases[0].loop.plant.parts[0]
    assert (len(inverses[0].model.weights), len(stage.weights)) == (20, 28)
    assert all(isinstance(case.loop.plant.parts[0], Preisach) for case in cases)


def test_the_shipped_comparison_is_valid():
    comparison = load_comparison_study(shipped("comparison/p753"))
    assert set(comparison.rates) == {1e3, 2e3, 5e3, 1e4, 2e4}
    one = comparison.model_copy(update={"rates": (2e3,)})
    found = {entry.controller: entry for entry in compared_cases(one, "p753.toml")}
    assert len(found) == len(comparison.controllers)
    tuned = found["model-reference PID-SMC"].case.loop.controller
    printed = p753_chapter4.MODEL_REFERENCE_GAINS["4-4"][2000]
    assert float(tuned.controller.law.integral) == printed["integral"]
    assert found["model-reference PID-SMC"].start == "printed"
    assert found["traditional PID-SMC"].start == "scaled"
    assert found["PID"].start == "rule"
