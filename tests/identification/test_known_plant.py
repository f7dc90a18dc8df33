"""A known plant fitted again: its prior, its delay, and what short records change."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jax import jacfwd

import piezojax as pj
from piezojax.core.paths import get, parameters, replace
from piezojax.dynamics import FirstOrderLag, FractionalDelay, Mode, Modes
from piezojax.hysteresis import PrandtlIshlinskii
from piezojax.identification import Record, identify
from piezojax.identification.estimators.error_problem import problem_of
from piezojax.identification.estimators.estimate import Options
from piezojax.identification.estimators.free_runs import free_run
from piezojax.identification.estimators.output_error import Optimum
from piezojax.identification.estimators.standard_errors import values_and_errors
from piezojax.identification.known_plant import CHANGED, KnownPlant

DT = 1e-4
ERRORS = {
    "hysteresis.polynomial.0": 1e-5,
    "hysteresis.weights.0": 1e-5,
    "dynamics.frequency": 0.1,
    "dynamics.damping": 1e-4,
}


def plant(gain=1.0, frequency=800.0, damping=0.03, delay=None):
    hysteresis = PrandtlIshlinskii((0.06,), (12.0,), (0.02,))
    parts = {"hysteresis": hysteresis, "dynamics": Mode(frequency, damping, DT)}
    if delay is not None:
        parts["delay"] = FractionalDelay(delay * DT, DT, 5)
    return pj.series(**parts, calibration=pj.Affine(gain, 0.3))


def known(errors=ERRORS, system=None):
    about = pj.About(standard_errors=errors, input_ranges=[(0.0, 100.0)])
    return KnownPlant(system or plant(), about)


def small_steps(level, seed=1, samples=1500):
    random = np.random.default_rng(seed)
    steps = np.repeat(random.uniform(0.0, 6.0, samples), random.choice([5, 12, 40], 1))
    return level + np.r_[np.zeros(100), steps][:samples]


def record(system, level, seed=1, noise=2e-3):
    drive = small_steps(level, seed)
    output = np.asarray(free_run(system, jnp.asarray(drive), float(drive[0])))
    random = np.random.default_rng(seed + 100)
    return Record(drive, output + noise * random.standard_normal(len(drive)), DT)


def fitted(system, levels=(30.0, 45.0)):
    records = [record(system, level, seed) for seed, level in enumerate(levels, 1)]
    start = known()
    return identify(records, start.model, options=Options(known=start))


@pytest.fixture(scope="module")
def unchanged():
    return fitted(plant())


def test_a_changed_stage_is_found_from_small_steps():
    fit = fitted(plant(gain=1.2, frequency=660.0, damping=0.02, delay=1.5))
    found = {path: one.value for path, one in fit.report.parameters.items()}
    assert found["dynamics.frequency"] == pytest.approx(660.0, rel=0.01)
    assert found["dynamics.damping"] == pytest.approx(0.02, rel=0.1)
    assert found["delay.delay"] / DT == pytest.approx(1.5, abs=0.1)
    assert fit.report.validation.rmse < 3e-3
    # The product of both gains is that of the stage for small motions.
    gain = found["calibration.gain"] * found["hysteresis.polynomial.0"]
    assert gain == pytest.approx(1.2 * 0.06, rel=0.03)


def test_an_unchanged_stage_keeps_its_parameters(unchanged):
    start = known()
    for path in ERRORS:
        value = float(get(start.system, path))
        assert float(get(unchanged.plant, path)) == pytest.approx(value, rel=0.05)


def test_what_records_do_not_show_keeps_its_value():
    """Motions below the threshold of a play say nothing about its weight."""
    fit = fitted(plant(gain=1.2))
    assert float(get(fit.plant, "hysteresis.weights.0")) == pytest.approx(0.02, rel=0.1)


def test_a_single_record_may_begin_anywhere():
    fit = fitted(plant(gain=1.2), levels=(50.0,))
    assert fit.report.train.rmse < 3e-3
    assert fit.report.validation.rmse < 3e-3


def test_the_bias_by_feedback_is_said():
    start, one = known(), record(plant(), 30.0)
    closed = Record(one.input, one.output, DT, reference=one.output)
    options = Options(known=start, steps=1)
    report = identify(closed, start.model, options=options).report
    assert report.closed_loop.startswith("free run from the measured input, near")


def test_a_run_that_ended_early_is_not_validated():
    start, one = known(), record(plant(), 30.0)
    whole = Record(one.input, one.output, DT, reference=one.output)
    early = Record(one.input[:600], one.output[:600], DT, reference=one.output[:600])
    options = Options(known=start, steps=1)
    both, alone = (
        identify(records, start.model, options=options).report
        for records in ([whole, early], whole)
    )
    assert np.isfinite(both.validation.rmse)
    assert both.validation.rmse == pytest.approx(alone.validation.rmse, rel=0.1)


def test_one_standard_deviation_costs_a_hundredth_of_the_range():
    start = known()
    one = record(plant(), 30.0)
    shape = start.structure([one])
    shape = shape.without(shape.own)
    problem = problem_of(shape, [one], slice(0, 1500))
    paths = problem.space.paths
    at = paths.index("calibration.gain")
    assert shape.prior is not None
    moved = shape.prior.known.copy()
    width = float(problem.space.upper[at] - problem.space.lower[at])
    moved[at] += CHANGED / width
    extra = np.asarray(problem.residuals(jnp.asarray(moved)))[-len(paths) :]
    assert extra[at] == pytest.approx(0.01 * one.span / np.sqrt(25), rel=1e-6)
    assert np.count_nonzero(extra) == 1


def standard_error(start, one, prior=True):
    """Return the standard error of the mode's frequency, at the known values."""
    shape = start.structure([one])
    shape = shape.without(shape.own)
    known = shape.prior.known
    shape = shape if prior else shape._replace(prior=None)
    problem = problem_of(shape, [one], slice(0, one.samples))
    loss = float(np.sum(problem.residuals(jnp.asarray(known)) ** 2))
    _, errors = values_and_errors(Optimum(problem, known[None], np.array([loss]), True))
    return errors[problem.space.paths.index("dynamics.frequency")]


def mode_record(drive):
    """Return the record of a known mode without offset, and the known plant."""
    system = pj.series(dynamics=Mode(1000.0, 0.01, DT), calibration=pj.Affine(0.06))
    noise = 2e-3 * np.random.default_rng(4).standard_normal(drive.size)
    output = np.asarray(free_run(system, jnp.asarray(drive), float(drive[0])))
    errors = {"dynamics.frequency": 30.0, "dynamics.damping": 1e-3}
    return known(errors, system), Record(drive, output + noise, DT)


@pytest.mark.parametrize("samples", [3000, 12_000])
def test_a_record_that_says_nothing_leaves_the_error_of_a_parameter(samples):
    # It begins without a jump of its slope, which would excite the mode.
    start, one = mode_record(np.cos(2.0 * np.pi * 2.0 * DT * np.arange(samples)))
    expected = np.hypot(30.0, CHANGED * 1000.0)
    assert standard_error(start, one) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("samples", [3000, 12_000])
def test_a_record_that_shows_a_parameter_gives_its_error(samples):
    random = np.random.default_rng(3)
    start, one = mode_record(10.0 * random.standard_normal(samples))
    alone = standard_error(start, one, prior=False)
    assert alone < 1.0
    assert standard_error(start, one) == pytest.approx(alone, rel=1e-3)


@pytest.mark.parametrize(("held", "factor"), [(False, 1.0), (True, 4.0)])
def test_errors_count_relative_to_the_range_if_dynamics_are_held(held, factor):
    small = record(plant(), 30.0)
    large = Record(4.0 * small.input, 4.0 * small.output, DT)
    start = known()
    start = start.with_dynamics(plant(delay=1.0)) if held else start
    shape = start.structure([large, small])
    shape = shape.without(shape.own)
    problem = problem_of(shape, [large, small], slice(0, 1500))
    of_large, of_small = np.asarray(problem.weights)
    np.testing.assert_allclose(of_small[100:1500], factor * of_large[100:1500])
    assert np.sum(problem.weights**2) == pytest.approx(1.0)


def test_held_dynamics_are_those_of_the_first_fit():
    """The hysteresis of the stage is another one: the large motion moves the mode."""
    stage = plant(frequency=700.0, delay=1.0)
    other = replace(stage, {"hysteresis.weights.0": 0.04})
    small = record(stage, 30.0)
    drive = 15.0 * (small.input - small.input[0])
    large = Record(drive, np.asarray(free_run(other, jnp.asarray(drive), 0.0)), DT)
    start = known()
    fast = identify(small, start.model, options=Options(known=start)).plant
    again = start.with_dynamics(fast)
    fit = identify([small, large], start.model, options=Options(known=again))
    for path in ("dynamics.frequency", "dynamics.damping", "delay.delay"):
        assert float(get(fit.plant, path)) == float(get(fast, path))
        assert path not in fit.report.parameters
    assert float(get(fast, "dynamics.frequency")) == pytest.approx(700.0, rel=0.02)
    assert "hysteresis.weights.0" in fit.report.parameters
    assert "calibration.gain" in fit.report.parameters


def test_the_jacobian_contains_the_prior():
    start = known()
    one = record(plant(), 30.0)
    shape = start.structure([one]).without(("hysteresis.rest_input",))
    problem = problem_of(shape, [one], slice(0, 1500))
    point = jnp.asarray(shape.starts[0] + 0.01)
    step = 1e-6
    found = np.asarray(jacfwd(problem.residuals)(point))
    for column in range(len(point)):
        change = step * np.eye(len(point))[column]
        up, down = (problem.residuals(point + s * change) for s in (1, -1))
        expected = np.asarray(up - down) / (2.0 * step)
        np.testing.assert_allclose(found[:, column], expected, rtol=1e-4, atol=1e-6)


def test_the_bounds_keep_the_sign_of_a_known_value():
    shape = known(ERRORS | {"calibration.offset": 1.0}).structure(
        [record(plant(), 30.0)]
    )
    ranges = shape.space.ranges()
    assert ranges["dynamics.frequency"].lower == pytest.approx(800.0 / 3.0)
    assert ranges["dynamics.frequency"].upper == pytest.approx(2400.0)
    assert ranges["calibration.offset"].lower < 0.0 < ranges["calibration.offset"].upper
    assert ranges["delay.delay"].lower == 0.0
    assert "calibration.offset" in shape.own


@pytest.mark.parametrize("delay", [None, 2.0, 4.9])
def test_a_delay_may_grow(delay):
    start = known(system=plant(delay=delay))
    shape = start.structure([record(plant(), 30.0)])
    before = delay or 0.0
    assert shape.space.ranges()["delay.delay"].upper >= (before + 3.9) * DT
    largest = shape.space.ranges()["delay.delay"].upper
    replace(shape.system, {"delay.delay": largest})  # within the longest delay
    assert float(get(shape.system, "delay.delay")) == pytest.approx(before * DT)


def test_the_search_also_starts_at_the_resonance_of_the_record_and_later():
    changed = record(plant(frequency=600.0), 30.0)
    shape = known().structure([changed])
    places = [*map(shape.space.paths.index, ("dynamics.frequency", "delay.delay"))]
    frequencies, delays = np.array(
        [
            np.asarray(shape.space.from_unit(jnp.asarray(u)))[places]
            for u in shape.starts
        ]
    ).T
    assert frequencies == pytest.approx([600.0, 800.0, 600.0, 800.0], rel=0.02)
    assert delays == pytest.approx([0.0, 0.0, DT, DT], abs=1e-3 * DT)


def test_the_range_of_the_known_record_remains(unchanged):
    assert unchanged.about.input_ranges == [(0.0, 100.0)]
    assert unchanged.about.input_slews == []  # those of the known record are not known
    fast, slow = (
        unchanged.known.about.model_copy(update={"input_slews": [slew]})
        for slew in (20.0, 10.0)
    )
    for first, second in ((fast, slow), (slow, fast)):
        plant_known = dataclasses.replace(unchanged.known, about=first)
        assert plant_known.widened(second).input_slews == [20.0]


def test_a_plant_without_fitted_parameters_is_refused():
    with pytest.raises(ValueError, match=r"no fitted parameters .*identify it"):
        known(errors={})


def test_a_plant_from_a_frequency_response_is_fitted_again():
    """It has no calibration, and nothing tells which voltages it covers."""
    system = pj.series(gain=pj.Affine(0.06), dynamics=Modes([800.0], [0.03], DT))
    errors = {"dynamics.frequency.0": 0.1, "dynamics.damping.0": 1e-4}
    start = KnownPlant(system, pj.About(standard_errors=errors, small_motions=True))
    changed = {"gain.gain": 0.07, "gain.offset": 0.3, "dynamics.frequency.0": 700.0}
    one = record(replace(system, changed), 30.0)
    fit = identify(one, start.model, options=Options(known=start))
    assert fit.report.train.rmse < 5e-3
    frequency = fit.report.parameters["dynamics.frequency.0"].value
    assert frequency == pytest.approx(700.0, rel=0.01)
    assert fit.about.input_ranges == [(one.input.min(), one.input.max())]
    assert fit.about.input_slews == pytest.approx(one.slews)


def test_a_plant_that_is_no_chain_is_refused():
    about = pj.About(standard_errors={"frequency": 1.0})
    for system in (Mode(800.0, 0.03, DT), pj.Affine(0.06) >> Mode(800.0, 0.03, DT)):
        with pytest.raises(ValueError, match="only a chain of named parts can be fit"):
            KnownPlant(system, about)


def test_the_model_is_named_by_its_parts():
    system = pj.series(
        hysteresis=PrandtlIshlinskii((0.06,), (12.0,), (0.02,)),
        lag=FirstOrderLag(1e-3, DT),
        calibration=pj.Affine(),
    )
    assert known(system=system).model == "prandtl_ishlinskii+lag"
    assert "calibration.gain" in parameters(system)
