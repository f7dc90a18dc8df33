"""Search baselines on a known minimum, and a comparison on a small study."""

import copy
import dataclasses
import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from study_tables import PID_ON_LAG

import piezojax as pj
from piezojax.cli.terminal import console
from piezojax.report.baseline_curves import (
    baselines_table,
    baselines_text,
    write_baselines,
)
from piezojax.solve.clock import Clock
from piezojax.solve.history import History
from piezojax.study import Study, build
from piezojax.tuning.baselines import Budget, cma_es, load_baselines, nelder_mead
from piezojax.tuning.baselines.baseline_runs import holdout_geomean
from piezojax.tuning.baselines.entries import BaselineEntry, with_ratios
from piezojax.tuning.data import make_data

METHODS = {
    "CMA-ES": cma_es(seed=2),
    "CMA-ES, larger": cma_es(14, seed=2),
    "Nelder-Mead": nelder_mead,
}


class Bowl(eqx.Module):
    """An objective with a given minimum."""

    minimum: jnp.ndarray

    def loss(self, unit):
        return jnp.sum(jnp.array([1.0, 3.0, 9.0]) * (unit - self.minimum) ** 2)


class Silent:
    def stage(self, text, steps=0):
        pass

    def advance(self, best):
        pass


STARTS = np.array([[0.8, 0.2, 0.9], [0.1, 0.1, 0.1]])
TIGHT = Budget(evaluations=3000, tolerance=1e-10)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("minimum", "expected"),
    [((0.3, 0.7, 0.55), (0.3, 0.7, 0.55)), ((0.3, 1.4, 0.55), (0.3, 1.0, 0.55))],
)
def test_the_minimum_inside_the_box(name, minimum, expected):
    objective = Bowl(jnp.array(minimum))
    found = METHODS[name](objective, STARTS, TIGHT, Silent())
    np.testing.assert_allclose(found.unit, expected, atol=2e-4)
    assert np.all((found.unit >= 0.0) & (found.unit <= 1.0))
    history = found.history
    assert history.loss == pytest.approx(float(objective.loss(found.unit)), rel=1e-12)
    assert history.evaluations[-1] <= TIGHT.evaluations
    assert np.all(np.diff(history.losses) <= 0.0)
    assert np.all(np.diff(history.times_s) >= 0.0)
    assert 0.0 < history.compile_s[-1] < history.times_s[-1]
    assert found.stop != "evaluations"
    assert "maxfevals" not in found.stop


@pytest.mark.parametrize("name", METHODS)
def test_the_budget_ends_a_search(name):
    few = Budget(evaluations=28, tolerance=1e-12)
    found = METHODS[name](Bowl(jnp.array([0.3, 0.7, 0.5])), STARTS, few, Silent())
    assert 28 <= found.history.evaluations[-1] <= 28 + 14
    assert found.stop in ("evaluations", "maxfevals")


def test_nelder_mead_searches_from_every_start():
    """Of two bowls, the one at the second start is deeper."""

    class Two(eqx.Module):
        def loss(self, unit):
            near = jnp.sum((unit - 0.8) ** 2)
            deep = jnp.sum((unit - 0.1) ** 2) - 0.05
            return jnp.minimum(near, deep)

    starts = np.array([[0.8, 0.8, 0.7], [0.1, 0.2, 0.1]])
    one, both = (
        nelder_mead(Two(), starts[:count], TIGHT, Silent()).unit for count in (1, 2)
    )
    np.testing.assert_allclose(one, 0.8, atol=1e-3)
    np.testing.assert_allclose(both, 0.1, atol=1e-3)


def test_a_history_has_the_time_of_a_loss():
    history = History(Clock())
    for loss in (3.0, 5.0, 1.0):
        history.add(4, loss)
    assert history.losses == [3.0, 3.0, 1.0]
    assert history.evaluations == [4, 8, 12]
    assert [history.reached(x) for x in (4.0, 3.0, 2.0, 0.5)] == [0, 0, 2, None]


def entry(**changes):
    numbers = dict(
        method="m", loss=1.0, holdout_geomean_um=0.1, evaluations=10, wall_s=20.0,
        compile_s=2.0, cpu_s=30.0, best_s=15.0, stop="", gains={},
    )  # fmt: skip
    return BaselineEntry(**(numbers | changes))


def test_the_ratio_is_that_of_the_times_to_the_same_loss():
    ours = entry(
        losses=[3.0, 1.0, 0.5],
        times_s=[2.0, 4.0, 9.0],
        compiled_s=[1.0, 3.0, 3.0],
        used_s=[1.0, 6.0, 7.0],
        evaluated=[5, 6, 7],
    )
    found = with_ratios(entry(), ours)
    assert (found.reached_s, found.reached_evaluations) == (4.0, 6)
    assert (found.ratio, found.ratio_running, found.ratio_best) == (5.0, 18.0, 3.75)
    assert found.ratio_cpu == 5.0
    assert with_ratios(entry(loss=0.4), ours).ratio is None
    assert with_ratios(entry(loss=None), ours).reached_s == 2.0


STUDY = PID_ON_LAG | {
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "references": {"tune": ["SIN50", "SW50"], "duration": 0.05, "settle": 0.02},
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 100.0, "scale": "log"},
        "controller.integral": {"lower": 100.0, "upper": 1e6, "scale": "log"},
    },
    "optimiser": {
        "method": "gauss_newton",
        "starts": 2,
        "candidates": 4,
        "steps": 25,
    },
}


def case_of(**changes):
    return build(Study.model_validate(copy.deepcopy(STUDY) | changes), "small.toml")


@pytest.fixture(scope="module")
def outcome():
    return pj.tune(case_of(), baselines=Budget(evaluations=150))


def test_baselines_use_the_same_objective(outcome):
    found = outcome.baselines
    names = [entry.method for entry in found.entries]
    assert names[:2] == ["Ziegler-Nichols PI", "Ziegler-Nichols PID"]
    assert names[-3:] == ["CMA-ES", "CMA-ES, population 12", "Nelder-Mead"]
    assert found.notes == []
    assert found.ours.loss == pytest.approx(min(outcome.result.history[-1]), abs=1e-9)
    assert found.ours.holdout_geomean_um == pytest.approx(
        outcome.result.holdout.geomean_rms_um, rel=1e-9
    )
    for entry in found.entries[-3:]:
        assert entry.loss == pytest.approx(found.ours.loss, abs=0.05)
    # The box of this study contains a PI by rule, so the searches are better.
    rule = found.entry("Ziegler-Nichols PI")
    assert rule.loss > found.ours.loss
    assert rule.unit is None


def test_a_rule_is_evaluated_like_tuned_gains(outcome):
    """The PI of the rule in the study has the loss and the error of the entry."""
    rule = outcome.baselines.entry("Ziegler-Nichols PI")
    table = {"type": "PID", "dt": 5e-5}
    table |= {path.split(".")[1]: value for path, value in rule.gains.items()}
    case = case_of(controller=table)
    data, start = make_data(case), round(0.02 * 20_000)
    error = holdout_geomean(case.loop, data, start)
    assert error == pytest.approx(rule.holdout_geomean_um, rel=1e-9)
    # The loss is computed from the tuning noise instead of the held-out noise.
    again = dataclasses.replace(data, holdout=data.tuning)
    tuned = holdout_geomean(case.loop, again, start)
    before = outcome.result.before.geomean_rms_um
    assert rule.loss == pytest.approx(np.log(tuned / before), rel=1e-9)


def test_the_steps_have_times(outcome):
    times = outcome.result.times_s
    assert len(times) == len(outcome.result.history)
    assert np.all(np.diff(times) > 0.0)
    assert times[-1] <= outcome.result.wall_s


def test_files_and_table(outcome, tmp_path, capsys):
    write_baselines(outcome.baselines, tmp_path)
    assert load_baselines(tmp_path) == outcome.baselines
    assert (tmp_path / "baselines.png").read_bytes().startswith(b"\x89PNG")
    console(False).print(baselines_table(outcome.baselines))
    printed = capsys.readouterr().out
    for entry in outcome.baselines.entries:
        assert entry.method.split()[-1] in printed
    assert "best baseline" in baselines_text(outcome.baselines)


def test_damaged_files(tmp_path):
    with pytest.raises(ValueError, match="No such file"):
        load_baselines(tmp_path)
    (tmp_path / "baselines.json").write_text(json.dumps({"study": 1}))
    with pytest.raises(ValueError, match="holds no baselines"):
        load_baselines(tmp_path)
