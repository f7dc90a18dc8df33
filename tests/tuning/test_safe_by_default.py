"""Default limits: kept if active, without effect if not, off on request."""

import pytest
import tomli_w

import piezojax as pj
from piezojax.analysis.stability import OperatingPoint, stability_report
from piezojax.tuning import limited_search
from piezojax.tuning.search import search_box

STUDY = {
    "title": "integral action on a stage with a light mode",
    "rate": 20_000.0,
    "seed": 5,
    "plant": {"catalog": "p753_stage"},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 200.0, "dt": 5e-5},
    "references": {
        "tune": ["SW50"],
        "amplitude": 2.0,
        "duration": 0.06,
        "settle": 0.02,
    },
    "parameters": {
        "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"}
    },
    "optimiser": {"method": "gauss_newton", "starts": 1, "candidates": 3, "steps": 20},
}


def tuned(folder, **tables):
    path = folder / "study.toml"
    path.write_text(tomli_w.dumps(STUDY | tables), encoding="utf-8")
    return pj.tune(path)


def exact(outcome):
    loop, dt = outcome.after, outcome.case.study.dt
    return stability_report(loop, OperatingPoint(outcome.case.margin_reference, dt=dt))


@pytest.fixture(scope="module")
def free(tmp_path_factory):
    """Tune without limits on margins."""
    off = {"sensitivity_peak": "off", "delay_margin": "off"}
    return tuned(tmp_path_factory.mktemp("free"), constraints=off)


@pytest.fixture(scope="module")
def safe(tmp_path_factory):
    return tuned(tmp_path_factory.mktemp("safe"))


def test_the_defaults_hold_where_unlimited_gains_violate_them(free, safe):
    assert exact(free).sensitivity_peak > 2.1
    assert free.result.constraints == {}
    assert 1.9 < exact(safe).sensitivity_peak < 2.02
    assert safe.result.constraints["sensitivity_peak"].kept
    assert safe.result.constraints["delay_margin"].limit == 1.0
    assert safe.result.after.worst_rms_um > free.result.after.worst_rms_um


def test_the_search_within_the_limits_also_descends_from_the_gains_without(
    tmp_path, monkeypatch, safe
):
    searches = []

    def stuck_the_second_time(*args, **options):
        search, strategy = search_box(*args, **options)
        searches.append(search)
        if len(searches) == 2:
            search.unit, search.loss = search.starts[0], 0.0
        return search, strategy

    monkeypatch.setattr(limited_search, "search_box", stuck_the_second_time)
    result = tuned(tmp_path).result
    assert len(searches) == 2
    assert result.constraints["sensitivity_peak"].kept
    assert result.after.worst_rms_um < 1.01 * safe.result.after.worst_rms_um
    assert result.after.worst_rms_um < 0.9 * result.before.worst_rms_um
