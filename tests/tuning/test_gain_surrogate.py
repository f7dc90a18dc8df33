"""Sliders of the tuned gains: simulated gain sets and their interpolation."""

from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
from study_tables import PID_ON_LAG, with_values

import piezojax as pj
from piezojax.analysis.step_response import step_ends
from piezojax.cli.tune import _surrogate
from piezojax.core.arrays import as_array
from piezojax.core.progress import Silent
from piezojax.study import Study, build
from piezojax.tuning import near_gains
from piezojax.tuning.data import make_data
from piezojax.tuning.gain_surrogate import fitted, gain_surrogate
from piezojax.tuning.near_gains import BATCH, MARGINS, NearGains, Simulated
from piezojax.tuning.outcome import Outcome

TABLES = PID_ON_LAG | {
    "references": {
        "tune": ["SIN50"],
        "unseen": ["SW50"],
        "duration": 0.04,
        "settle": 0.01,
    },
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 5.0, "scale": "log"},
        "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"},
    },
}
TUNED = {"controller.proportional": 2.0, "controller.integral": 8e3}


def outcome_of(**fields):
    """Return an Outcome with some of its fields."""
    found = object.__new__(Outcome)
    vars(found).update(fields)
    return found


def tuned(gains=TUNED, **changes):
    """Return what the surrogate needs of an Outcome whose tuned gains are ``gains``."""
    case = build(Study.model_validate(with_values(TABLES, changes)), "small.toml")
    unit = case.space.to_unit(as_array([*gains.values()]))
    return outcome_of(
        case=case,
        after=case.space.put(case.loop, unit),
        holdout=make_data(case).holdout,
        result=SimpleNamespace(gains=gains),
    )


@pytest.fixture(scope="module")
def outcome():
    return tuned()


@pytest.fixture(scope="module")
def near(outcome):
    return near_gains.simulate_near(outcome)


# Simulation


def gains_at(near, index):
    """Return P and I of a gain set of ``near``, on the scales of ``TABLES``."""
    unit = near.lower + (near.upper - near.lower) * near.places[index]
    return 0.1 * 50.0 ** unit[0], 100.0 * 200.0 ** unit[1]


def pid_on_lag(gains, reference, noise):
    """Return the displacements of the loop of ``TABLES``, from rest at the reference.

    It is written from the equations, with the limits of the voltage.
    """
    proportional, integral = gains
    dt, pole = 5e-5, np.exp(-5e-5 / 1e-3)
    y, total, found = reference[0], reference[0], []
    for wanted, disturbance in zip(reference, noise, strict=True):
        found.append(y)
        error = wanted - (y + disturbance)
        total += integral * dt * error
        voltage = np.clip(proportional * error + total, -20.0, 120.0)
        y = pole * y + (1.0 - pole) * voltage
    return np.array(found)


@pytest.mark.parametrize("index", [0, 7, BATCH, BATCH + 1, BATCH + 4, -1])
def test_gain_sets_are_simulated_as_a_loop_of_numpy_does(near, outcome, index):
    signals, start = outcome.holdout, outcome.case.study.settled
    for run in range(2):
        reference = np.asarray(signals.references[run])
        noise = 0.012 * np.asarray(signals.noise[run, 0])
        error = pid_on_lag(gains_at(near, index), reference, noise) - reference
        rms = np.sqrt(np.mean(error[start:] ** 2))
        found = np.linalg.norm(near.simulated.errors[index, run])
        assert found == pytest.approx(rms, rel=1e-9)


def test_the_step_is_that_of_a_loop_of_numpy(near, outcome):
    before, after = step_ends(np.asarray(outcome.holdout.references))[0]
    reference = np.full(300, after)
    reference[0] = before
    found = pid_on_lag(gains_at(near, 3), reference, np.zeros(300))
    samples = np.rint(near.times / 5e-5).astype(int) + 1  # of 0.015 s
    kept = samples < 300
    step = near.simulated.step[3, kept]
    np.testing.assert_allclose(step, found[samples[kept]], rtol=1e-9)


@pytest.mark.parametrize("index", [0, BATCH, BATCH + 2])
def test_margins_are_those_of_the_stability_report(near, outcome, index):
    unit = near.lower + (near.upper - near.lower) * near.places[index]
    loop = outcome.case.space.put(outcome.case.loop, as_array(unit))
    report = pj.stability_report(loop, outcome.case.margin_reference)
    found = dict(zip(MARGINS, near.simulated.margins[index], strict=True))
    assert found["sensitivity peak"] == pytest.approx(report.sensitivity_peak, rel=3e-3)
    assert found["gain margin"] == pytest.approx(report.gain_margin_dB, rel=3e-3)
    assert found["phase margin"] == pytest.approx(report.phase_margin_deg, rel=3e-3)
    delay = report.delay_margin_samples
    assert found["delay margin"] == pytest.approx(delay, rel=3e-3)


def test_the_sets_hold_the_tuned_one_and_every_end(near, outcome):
    own = gains_at(near, BATCH)
    assert own == pytest.approx([*TUNED.values()])
    ends = near.places[BATCH + 1 : BATCH + 5]
    assert [tuple(row == near.places[BATCH]) for row in ends] == [
        (False, True),
        (True, False),
    ] * 2
    assert {float(x) for x in ends[ends != near.places[BATCH]]} == {0.0, 1.0}
    assert gains_at(near, BATCH + 1)[0] == pytest.approx(TUNED[next(iter(TUNED))] / 2)


def test_a_tuned_gain_on_its_bound_is_one_set():
    found = near_gains.simulate_near(tuned(TUNED | {"controller.integral": 2e4}))
    assert len(np.unique(found.places, axis=0)) == len(found.places)
    assert found.upper[1] == 1.0


def test_the_range_shrinks_until_all_gain_sets_are_stable():
    wide = {"parameters/controller.proportional/upper": 200.0}
    tight = tuned(TUNED | {"controller.proportional": 17.0}, **wide)
    found = near_gains.simulate_near(tight)
    assert np.all(found.simulated.stable)
    assert np.max(found.simulated.margins[:, 0]) <= near_gains.LARGEST_PEAK
    box = tight.case.space.ranges()["controller.proportional"]
    widest = np.log(near_gains.WIDEST) / np.log(box.upper / box.lower)
    halvings = np.log2(2 * widest / (found.upper - found.lower)[0])
    assert halvings == pytest.approx(round(halvings))
    assert halvings > 0.5


def test_no_surrogate_is_made_at_the_edge_of_stability():
    wide = {"parameters/controller.proportional/upper": 200.0}
    found = gain_surrogate(tuned(TUNED | {"controller.proportional": 38.0}, **wide))
    assert "a sensitivity peak above 5" in found


def test_an_interrupt_ends_the_wait_alone():
    found = Future()
    found.set_exception(KeyboardInterrupt())
    assert _surrogate(found, Silent()) == "interrupted"


def test_axes_and_many_gains_have_no_surrogate(outcome):
    several = SimpleNamespace(study=SimpleNamespace(axes="x, y"))
    axes = outcome_of(case=several)
    assert gain_surrogate(axes) == "they are for one axis only"
    space = SimpleNamespace(paths=["gain"] * 13)
    study = outcome.case.study
    many = outcome_of(case=SimpleNamespace(study=study, space=space))
    assert gain_surrogate(many) == "13 gains are tuned, and they are for 12 at most"


# Interpolation

PHASES = np.linspace(0.0, 2.0 * np.pi, 101)


def closed_form(places):
    """Return the rms error of places whose error vanishes at one of them."""
    return np.hypot(places[:, 0] - 0.4, 2.0 * (places[:, 1] - 0.6) ** 2)


def with_a_kink(margins, count=96, seed=5):
    """Return gain sets whose errors have the rms of ``closed_form``."""
    places = np.random.default_rng(seed).random((count, 2))
    first = (places[:, 0] - 0.4)[:, None] * np.sin(PHASES)
    second = (2.0 * (places[:, 1] - 0.6) ** 2)[:, None] * np.cos(PHASES)
    basis = np.stack([np.sin(PHASES), np.cos(PHASES)])
    scale = np.linalg.norm(basis, axis=1)[:, None]
    errors = first / scale[0] + second / scale[1]
    step = 3.0 + np.exp(-np.outer(1.0 + places[:, 0], PHASES))
    found = Simulated(errors[:, None], step, margins(places), np.ones(count, bool))
    return NearGains(np.zeros(2), np.ones(2), places, found, PHASES)


def smooth(places):
    x, y = places.T
    return np.stack([1.2 + 0.3 * x * y, 10 + x, 60 - 5 * y, 4 + np.sin(x + y)], axis=1)


def test_an_error_that_vanishes_is_interpolated_exactly():
    surrogate = fitted(with_a_kink(smooth), ("a",))
    line = np.stack([np.linspace(0.3, 0.5, 21), np.full(21, 0.6)], axis=1)
    found = [surrogate.at(place).errors[0] for place in line]
    np.testing.assert_allclose(found, closed_form(line), atol=2e-4)
    assert found[10] < 2e-4  # a kink, on which the rms itself could not be interpolated


def test_margins_and_the_step_are_interpolated():
    surrogate = fitted(with_a_kink(smooth), ("a",))
    place = np.array([0.37, 0.81])
    figures = surrogate.at(place)
    np.testing.assert_allclose(figures.margins, smooth(place[None])[0], rtol=1e-4)
    step = 3.0 + np.exp(-1.37 * PHASES)
    np.testing.assert_allclose(figures.step, step, rtol=1e-3)
    assert surrogate.margins == tuple(MARGINS)
    assert all(surrogate.doubt.margins < 1e-3)


def test_an_unlimited_margin_is_left_out():
    def unlimited(places):
        found = smooth(places)
        found[3, 1] = MARGINS["gain margin"].unlimited
        return found

    surrogate = fitted(with_a_kink(unlimited), ("a",))
    assert surrogate.margins == ("sensitivity peak", "phase margin", "delay margin")
    assert surrogate.at(surrogate.tuned).margins.size == 3


def test_the_stated_errors_are_those_of_unseen_gain_sets():
    near = with_a_kink(smooth)
    rough = near.simulated.margins.copy()
    rough[:BATCH, 2] *= 1.0 + 0.1 * np.where(np.arange(BATCH) % 2, 1.0, -1.0)
    near = near._replace(simulated=near.simulated._replace(margins=rough))
    surrogate = fitted(near, ("a",))
    assert surrogate.doubt.margins[2] == pytest.approx(0.1 / 0.9, rel=1e-2)
    assert surrogate.doubt.margins[0] < 1e-3


def test_the_surrogate_of_a_loop_is_near_its_simulation(near, outcome):
    surrogate = gain_surrogate(outcome)
    assert surrogate.references == ("SIN50", "SW50")
    own = np.linalg.norm(near.simulated.errors[BATCH], axis=1)
    found = surrogate.at(surrogate.tuned)
    np.testing.assert_allclose(found.errors, own, rtol=1e-4)
    assert surrogate.doubt.mean < 0.01
    assert max(surrogate.doubt.errors) < 0.01
    assert max(surrogate.doubt.margins) < 0.01
