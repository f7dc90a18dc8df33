"""Margins on drawn plants whose oscillations outlast the impulse response of a search.

The oracle has the transfer functions of the loop, from SciPy.
"""

import numpy as np
import pytest
import tomli_w
from scipy import signal

import piezojax as pj
from piezojax.analysis.constraints import worst_by_plant
from piezojax.analysis.stability.closed_poles import poles_of, stable
from piezojax.analysis.stability.small_motion import DURATION, duration_of
from piezojax.core.paths import get, replace
from piezojax.dynamics import Modes
from piezojax.solve.clock import Clock
from piezojax.study import read
from piezojax.tuning.data import make_data
from piezojax.tuning.evaluator import MOST, SETTLED, Evaluator, drawn_stages
from piezojax.tuning.held_out import held_out
from piezojax.tuning.result import Perturbed
from piezojax.tuning.tuner import tune

DT, FREQUENCY, GAIN, INTEGRAL = 1e-3, 50.0, 0.1, 11.6
STUDY = {
    "title": "A slow mode of little damping",
    "rate": 1.0 / DT,
    "plant": {"file": "model.json"},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {
        "type": "PID",
        "proportional": 0.0,
        "integral": INTEGRAL,
        "dt": DT,
    },
    "references": {"tune": ["SIN1"], "duration": 1.0, "amplitude": 3.0},
    "parameters": {"controller.integral": {"lower": 1.0, "upper": 100.0}},
    "ensemble": {"holdout": 20, "range": {"plant.dynamics.damping.0": [1e-3, 7e-3]}},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the model of the stage."""
    folder = tmp_path_factory.mktemp("slow")
    modes = Modes([FREQUENCY], [4e-3], DT, [], [])
    system = pj.series(gain=pj.core.system.Affine(GAIN), dynamics=modes)
    pj.save(system, folder / "model.json", pj.About(rate_Hz=1.0 / DT))
    return folder


@pytest.fixture(scope="module")
def drawn(folder):
    """Return the figures on the held-out plants, and their damping ratios."""
    (folder / "study.toml").write_text(tomli_w.dumps(STUDY))
    case = read(folder / "study.toml")
    own = held_out(case, Evaluator(Clock(), case), make_data(case))
    assert own.stages is not None
    gentle = own.with_loop(replace(case.loop, {"controller.integral": 1.0}))
    damping = np.asarray(get(own.stages.plant, "dynamics.damping.0"))
    return own.perturbed, gentle.perturbed, damping


def poles_and_peak(damping, integral=INTEGRAL):
    """Return the closed-loop poles and max |S| of one plant."""
    w = 2.0 * np.pi * FREQUENCY
    held = signal.cont2discrete(
        ([GAIN * w**2], [1.0, 2.0 * damping * w, w**2]), DT, "zoh"
    )
    plant, own = held[0].ravel(), held[1]
    forward = integral * DT * np.polymul([1.0, 0.0], plant)
    back = np.polymul([1.0, -1.0], own)
    poles = np.roots(np.polyadd(forward, back))
    angle = np.linspace(0.2, 0.5, 400_000)
    z = np.exp(1j * angle)
    L = np.polyval(forward, z) / np.polyval(back, z)
    return poles, np.max(np.abs(1.0 / (1.0 + L)))


def test_unstable_plants_are_found(drawn):
    figures, _, damping = drawn
    expected = [np.all(np.abs(poles_and_peak(each)[0]) < 1.0) for each in damping]
    assert 0 < sum(expected) < len(expected)
    assert np.asarray(figures.stable).tolist() == expected


def test_the_peaks_are_those_of_the_whole_oscillation(drawn):
    figures, _, damping = drawn
    found = worst_by_plant(["sensitivity_peak", "delay_margin"], figures)
    truncated = 0
    for rests, peak, delay, each in zip(
        figures.stable, *found.values(), damping, strict=True
    ):
        poles, expected = poles_and_peak(each)
        if not rests:
            assert np.isinf(peak)
            assert delay == 0.0
            continue
        assert peak == pytest.approx(expected, rel=0.02)
        lasts = DT / -np.log(np.abs(poles[np.abs(np.angle(poles)) > 0.1])).max()
        truncated += lasts > 2.0 * DURATION
    assert truncated > 3  # 0.2 s would not show these


def test_a_search_keeps_the_limit_that_the_poles_show(folder):
    """An impulse response of 0.512 s hides that the first gain is unstable."""
    table = {
        **STUDY,
        "constraints": {"sensitivity_peak": 2.0},
        "optimiser": {"starts": 2, "candidates": 8},
    }
    del table["ensemble"]
    (folder / "search.toml").write_text(tomli_w.dumps(table))
    case = read(folder / "search.toml")
    assert case.margin_duration == pytest.approx(8 * 0.512)  # over 4 / (0.004 w)
    found = tune(case).result
    integral = found.gains["controller.integral"]
    _, peak = poles_and_peak(4e-3, integral)
    assert 1.9 < peak < 2.0 * 1.001


def test_a_search_keeps_the_limit_on_drawn_plants_that_ring_longer(folder):
    """Plants with a quarter of the damping oscillate four times as long as the own."""
    table = {
        **STUDY,
        "constraints": {"sensitivity_peak": 2.0},
        "ensemble": {**STUDY["ensemble"], "margins": 4, "holdout": 1},
        "optimiser": {"starts": 1, "candidates": 4, "steps": 15},
    }
    (folder / "drawn.toml").write_text(tomli_w.dumps(table))
    case = read(folder / "drawn.toml")
    stages = drawn_stages(case, "margins")
    assert stages is not None
    found = tune(case).result
    integral = found.gains["controller.integral"]
    dampings = np.asarray(get(stages.plant, "dynamics.damping.0"))
    peaks = [poles_and_peak(damping, integral)[1] for damping in dampings]
    assert 1.85 < max(peaks) < 2.0 * 1.005
    assert found.constraints["sensitivity_peak"].kept
    # The margins of a search hide it on a loop that violates the limit.
    larger = replace(case.loop, {"controller.integral": 1.3 * integral})
    evaluator = Evaluator(Clock(), case)
    figures = evaluator.worst_plants(larger, evaluator.worst_plants(larger))
    expected = max(poles_and_peak(damping, 1.3 * integral)[1] for damping in dampings)
    assert figures.peak == pytest.approx(expected, rel=0.01)
    assert figures.excess == pytest.approx(np.log(figures.peak / 2.0), abs=1e-3)


def test_unstable_plants_are_counted(drawn):
    figures, gentle, _ = drawn
    summary = Perturbed.of(gentle, figures, np.array([True]), {"sensitivity_peak": 2.0})
    assert summary.unstable == np.sum(~np.asarray(figures.stable))
    assert summary.unstable_before == 0
    assert not summary.constraints["sensitivity_peak"].kept


def test_a_branch_that_is_not_finite_hides_no_unstable_one():
    closed = np.stack([np.full((2, 2), np.nan), np.diag([1.2, 0.5])])
    calm = np.stack([closed[0], np.diag([0.9, 0.5])])
    poles = poles_of(np.stack([closed, calm]))
    assert stable(poles).tolist() == [False, True]


@pytest.mark.parametrize(
    ("time_constant", "dt", "expected"),
    [(0.07, 1e-3, 0.512), (0.1, 1e-3, 1.024), (1e3, 1e-3, 2**17 * 1e-3)],
)
def test_the_response_lasts_as_long_as_it_must(time_constant, dt, expected):
    assert duration_of(time_constant, dt, SETTLED, MOST) == pytest.approx(expected)


def test_a_fast_loop_keeps_its_default_duration():
    found = duration_of(0.04, 1.28e-6, SETTLED, MOST)
    assert found == pytest.approx(DURATION, rel=1e-4)
