"""The next record: information, promised figures, and voltages that determine them."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import hysteresis
from page_reader import checked
from scipy import signal
from small_runs import call, succeeded
from study_tables import with_values

import piezojax as pj
from piezojax.cli.excite import known_slew
from piezojax.core.feedback import loop_inputs
from piezojax.core.progress import Silent
from piezojax.core.rollout import simulate
from piezojax.identification.records.sampled import read_sampled
from piezojax.signals.excitation import Generator, mixture, two_levels
from piezojax.study import read
from piezojax.tuning import record_search
from piezojax.tuning.next_record import make_task, next_record, unknowns_of
from piezojax.tuning.promised_figures import promised_figures
from piezojax.tuning.result import load_loop

RATE, NOISE, SAMPLES = 5_000.0, 0.01, 1_000
TRUE = {
    "hysteresis.a": 0.01,
    "hysteresis.b": 0.12,
    "hysteresis.c": -0.05,
    "mode.frequency": 2.0 * np.pi * 700.0,
    "mode.damping": 0.03,
}
GENERATOR = Generator(-50.0, 50.0, RATE, 2e4, slowest=20.0, hold=0.05)
STUDY = {
    "title": "an integrator on a light mode",
    "rate": RATE,
    "seed": 3,
    "plant": {"file": "model.json"},
    "actuator": {"lower": -50.0, "upper": 50.0},
    "sensor": {"noise_rms": NOISE},
    "controller": {
        "type": "PID",
        "proportional": 0.0,
        "integral": 500.0,
        "derivative": 0.0,
        "dt": 1.0 / RATE,
    },
    "references": {
        "tune": ["SIN10", "SW30"],
        "amplitude": 3.0,
        "duration": 0.2,
        "settle": 0.1,
    },
    "parameters": {"controller.integral": {"lower": 50.0, "upper": 2e3}},
}


def plant():
    a, b, c = (TRUE[f"hysteresis.{name}"] for name in "abc")
    frequency, damping = TRUE["mode.frequency"], TRUE["mode.damping"]
    return pj.series(
        hysteresis=pj.hysteresis.ColemanHodgdon(a, b, c),
        mode=pj.dynamics.SecondOrderLag(frequency, damping, 1.0 / RATE),
        calibration=pj.Affine(1.0),
    )


def write_study(folder, changes=None, errors=0.01):
    """Write a study of the plant as if it had been fitted; return its path."""
    known = {path: errors * abs(value) for path, value in TRUE.items()}
    about = pj.About(
        record="bench.csv",
        rate_Hz=RATE,
        input_slews=[2e4],
        units={"input": "V", "output": "um"},
        parameter_units={path: "rad/s" for path in TRUE if "frequency" in path},
        standard_errors=known | {"calibration.offset": 0.1} if errors else {},
    )
    pj.save(plant(), folder / "model.json", about)
    path = folder / "study.toml"
    tables = with_values(STUDY, changes or {})
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return read(write_study(tmp_path_factory.mktemp("study")))


@pytest.fixture(scope="module")
def task(case):
    return make_task(case, case.loop, GENERATOR, SAMPLES, unknowns_of(case))


@pytest.fixture(scope="module")
def designed(task):
    random = np.random.default_rng(0)
    found = record_search.best_voltages(
        task.search, GENERATOR, 4, random, lambda loss: None
    )
    return found.voltages


def numpy_output(values, voltages):
    """Return the displacement of the plant, from equations (3.8) and a held input."""
    a, b, c = (values[f"hysteresis.{name}"] for name in "abc")
    bent = hysteresis.trapezoid(voltages, a, b, c)
    frequency, damping = values["mode.frequency"], values["mode.damping"]
    top, bottom = [frequency**2], [1.0, 2.0 * damping * frequency, frequency**2]
    top, bottom, _ = signal.cont2discrete((top, bottom), 1.0 / RATE)
    # The plant adds no sample: u(k) moves it to y(k+1), as the zero-order hold does.
    return signal.lfilter(np.ravel(top), bottom, bent)


def numpy_jacobian(voltages):
    """Return the derivatives [samples, n + 1] by relative parameters, and the zero."""
    columns = []
    for path, value in TRUE.items():
        ends = (
            numpy_output(TRUE | {path: value + abs(value) * step}, voltages)
            for step in (1e-5, -1e-5)
        )
        columns.append(np.subtract(*ends) / 2e-5)
    return np.column_stack([*columns, np.ones(voltages.size)])


def test_the_unknowns_are_the_fitted_parameters_without_those_of_each_record(case):
    unknowns = unknowns_of(case)
    assert set(unknowns.paths) == set(TRUE)
    scales = dict(zip(unknowns.paths, np.asarray(unknowns.scales), strict=True))
    assert scales == pytest.approx({path: abs(value) for path, value in TRUE.items()})


def test_the_information_is_that_of_an_independent_loop(task):
    voltages = mixture(GENERATOR, SAMPLES, np.random.default_rng(4))
    unknowns = task.search.unknowns
    found = unknowns.information(jnp.asarray(voltages), jnp.asarray(NOISE))
    jacobian = numpy_jacobian(voltages)
    order = [*(list(TRUE).index(path) for path in unknowns.paths), -1]
    expected = (jacobian.T @ jacobian / NOISE**2)[np.ix_(order, order)]
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / size, expected / size, atol=1e-6)


def test_the_sensitivities_predict_the_errors_of_a_changed_plant(case, task):
    change = 1e-4 * np.array([1.0, -2.0, 1.5, 3.0, -20.0])
    for figure, run in zip(task.figures, case.references, strict=False):
        signals = [
            _error(case, run, jnp.asarray(scale * change), task) for scale in (1, -1)
        ]
        moved = np.sqrt(np.mean((0.5 * np.subtract(*signals)) ** 2))
        expected = figure.relative_error(np.outer(change, change)) * figure.value
        assert 1e3 * moved == pytest.approx(expected, rel=0.02)


def _error(case, reference, change, task):
    loop = dataclasses.replace(case.loop, plant=task.search.unknowns.at(change))
    inputs = loop_inputs(jnp.asarray(reference))
    _, found = simulate(loop, inputs, loop.init(reference[0]))
    return np.asarray(found.displacement - reference)[case.study.settled :]


def test_the_figures_are_the_errors_of_the_references_and_the_limited_margins(task):
    names = [figure.name for figure in task.figures]
    assert names == ["SIN10", "SW30", "sensitivity_peak", "delay_margin"]
    peak = task.figures[2]
    # An integrator has margins that scale with its gain, here with b and the mode.
    slopes = dict(
        zip(
            task.search.unknowns.paths,
            np.sqrt(np.diag(peak.sensitivity)),
            strict=True,
        )
    )
    assert slopes["mode.damping"] > 0.05
    assert peak.unit == "1"


def test_limits_that_are_off_are_no_figures(tmp_path):
    off = {f"constraints/{n}": "off" for n in ("sensitivity_peak", "delay_margin")}
    case = read(write_study(tmp_path, off))
    found = promised_figures(case, case.loop, unknowns_of(case))
    assert [figure.name for figure in found] == ["SIN10", "SW30"]


@settings(max_examples=30, deadline=None)
@given(
    every=st.integers(1, 7),
    samples=st.integers(2, 300),
    slew=st.floats(1e2, 1e6),
    seed=st.integers(0, 1000),
    size=st.floats(0.0, 1.0),
)
def test_no_point_of_the_search_exceeds_the_limits(
    task, every, samples, slew, seed, size
):
    generator = Generator(-20.0, 120.0, RATE, slew)
    search = dataclasses.replace(
        task.search,
        lower=jnp.asarray(-20.0),
        upper=jnp.asarray(120.0),
        most=jnp.asarray(min(slew * every / RATE, 140.0)),
        samples=samples,
        every=every,
    )
    random = np.random.default_rng(seed)
    moves = size * random.choice([-1.0, 1.0], search.knots)
    for voltages in (
        np.asarray(search.voltages(jnp.asarray(moves))),
        mixture(generator, samples, random),
        two_levels(generator, samples, random),
    ):
        assert voltages.shape == (samples,)
        assert voltages[0] == pytest.approx(50.0)
        assert voltages.min() >= -20.0 - 1e-9
        assert voltages.max() <= 120.0 + 1e-9
        assert RATE * np.abs(np.diff(voltages)).max() <= slew * (1.0 + 1e-9)


def test_the_moves_of_voltages_give_these_voltages(task):
    voltages = mixture(GENERATOR, SAMPLES, np.random.default_rng(1))
    moves = task.search.moves(voltages)
    assert task.search.every == 1
    found = task.search.voltages(jnp.asarray(moves))
    np.testing.assert_allclose(found, voltages, atol=1e-9)


def test_two_levels_lie_around_the_middle_of_the_range():
    fast = Generator(-20.0, 120.0, RATE, 1e9)
    voltages = two_levels(fast, SAMPLES, np.random.default_rng(3))
    levels = np.unique(voltages[1:].round(9))
    assert levels.size == 2
    assert levels.mean() == pytest.approx(50.0)


def test_a_descent_reports_the_least_loss_and_returns_it(task, monkeypatch):
    monkeypatch.setattr(record_search, "TRIALS", 4)
    monkeypatch.setattr(record_search, "ROUGH", 5)
    monkeypatch.setattr(record_search, "FINE", 8)
    losses = []
    found = record_search.best_voltages(
        task.search, GENERATOR, 2, np.random.default_rng(0), losses.append
    )
    assert len(losses) == record_search.report_count(2) == 4 + 2 * 5 + 8
    assert losses[-1] == min(losses) < losses[3]
    assert not found.interrupted
    loss = task.search.loss(jnp.asarray(task.search.moves(found.voltages)))
    assert float(loss) == pytest.approx(losses[-1], abs=1e-6)


def test_an_interrupted_search_returns_the_best_record_so_far(task):
    losses = []

    def interrupted(loss):
        losses.append(loss)
        if len(losses) == 7:
            raise KeyboardInterrupt

    found = record_search.best_voltages(
        task.search, GENERATOR, 2, np.random.default_rng(0), interrupted
    )
    assert len(losses) == 7
    assert found.interrupted
    loss = task.search.loss(jnp.asarray(task.search.moves(found.voltages)))
    assert float(loss) == pytest.approx(losses[-1], abs=1e-6)


def test_an_interrupted_design_does_not_begin_another_search(case, monkeypatch):
    monkeypatch.setattr(record_search, "TRIALS", 3)

    class Interrupting(Silent):
        steps = 0

        def advance(self, best, note=""):
            self.steps += 1
            if self.steps == 5:
                raise KeyboardInterrupt

    progress = Interrupting()
    found = next_record(case, case.loop, GENERATOR, 200, progress=progress)
    # The second half is the best of its random records.
    assert progress.steps == 5 + record_search.report_count(0) == 5 + 3
    assert 0 < found.validate.size <= 200
    assert found.report.figures


def test_an_interruption_before_the_first_record_ends_the_design(task, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(record_search, "mixture", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record_search.best_voltages(
            task.search, GENERATOR, 1, np.random.default_rng(0), print
        )


def test_a_record_without_a_finite_loss_is_never_the_best(task, monkeypatch):
    monkeypatch.setattr(record_search, "TRIALS", 4)
    monkeypatch.setattr(record_search, "ROUGH", 2)
    monkeypatch.setattr(record_search, "FINE", 2)
    actual, calls = record_search._loss, []

    def first_is_not_finite(search, moves):
        calls.append(None)
        return jnp.asarray(jnp.nan) if len(calls) == 1 else actual(search, moves)

    monkeypatch.setattr(record_search, "_loss", first_is_not_finite)
    losses = []
    record_search.best_voltages(
        task.search, GENERATOR, 1, np.random.default_rng(0), losses.append
    )
    assert losses[0] == np.inf
    assert np.isfinite(losses[1:]).all()


def test_a_model_without_finite_records_is_refused(task):
    search = dataclasses.replace(task.search, noise=jnp.asarray(jnp.nan))
    with pytest.raises(ValueError, match="not finite in any of the random records"):
        record_search.best_voltages(
            search, GENERATOR, 1, np.random.default_rng(0), lambda loss: None
        )


def test_the_slope_of_the_loss_is_that_of_finite_differences(task):
    # A hysteresis has no slope where a move is 0.
    moves = np.random.default_rng(2).uniform(-0.9, 0.9, task.search.knots)
    slope = jax.grad(task.search.loss)(jnp.asarray(moves))
    for place in (3, 200, 700):
        step = np.zeros_like(moves)
        step[place] = 1e-6
        ends = [float(task.search.loss(jnp.asarray(moves + s * step))) for s in (1, -1)]
        assert slope[place] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3)


def limited(wanted):
    """Return voltages that follow ``wanted`` within the slew rate, from 0 V."""
    most, found = GENERATOR.slew / RATE, [0.0]
    for target in wanted[1:]:
        found.append(found[-1] + np.clip(target - found[-1], -most, most))
    return np.array(found)


def others():
    """Yield a sine, chirps and PRBS with the same limits."""
    time, random = np.arange(SAMPLES) / RATE, np.random.default_rng(7)
    for frequency in (10.0, 50.0, 200.0, 700.0):
        height = min(50.0, GENERATOR.slew / (2.0 * np.pi * frequency))
        yield height * np.sin(2.0 * np.pi * frequency * time)
    chirp = signal.chirp(time, 10.0, time[-1], 2e3, "logarithmic", phi=-90.0)
    for height in (50.0, 10.0):
        yield limited(height * chirp)
        for clock in (1, 2, 4, 10, 25, 60):
            bits = random.choice([-1.0, 1.0], SAMPLES)
            yield limited(height * np.repeat(bits, clock)[:SAMPLES])


def test_the_designed_record_is_better_than_others_of_the_same_limits(task, designed):
    errors = task.errors(designed)[0]
    best = min(np.sum(task.errors(voltages)[0] ** 2) for voltages in others())
    assert np.sqrt(best / np.sum(errors**2)) > 1.7


def test_estimates_scatter_as_predicted(task, designed):
    """Linear least squares on 400 records with noise, in NumPy."""
    figures, parameters = task.errors(designed)
    random = np.random.default_rng(11)
    true, jacobian = numpy_output(TRUE, designed), numpy_jacobian(designed)
    paths = task.search.unknowns.paths
    places = [list(TRUE).index(path) for path in paths]
    found = []
    for _ in range(400):
        measured = true + NOISE * random.standard_normal(true.size) + 0.3
        found.append(np.linalg.lstsq(jacobian, measured - true, rcond=None)[0][places])
    covariance = np.cov(np.transpose(found))
    scales = np.abs([TRUE[path] for path in paths])
    np.testing.assert_allclose(
        scales * np.sqrt(np.diag(covariance)), parameters, rtol=0.12
    )
    estimated = [figure.relative_error(covariance) for figure in task.figures]
    np.testing.assert_allclose(estimated, figures, rtol=0.12)


def test_a_record_begins_and_ends_at_the_middle_and_repeats(case, monkeypatch):
    monkeypatch.setattr(record_search, "TRIALS", 3)
    monkeypatch.setattr(record_search, "ROUGH", 2)
    monkeypatch.setattr(record_search, "FINE", 2)
    one, two = (next_record(case, case.loop, GENERATOR, 200, seed=5) for _ in range(2))
    np.testing.assert_array_equal(one.fit, two.fit)
    for half in (one.fit, one.validate):
        assert half[0] == 0.0
        assert half[-1] == 0.0
        assert half.size <= 200
        assert RATE * np.abs(np.diff(half)).max() <= 2e4 * (1.0 + 1e-9)
    assert not np.array_equal(one.fit[:200], one.validate[:200])
    assert one.report.designed_s <= 200 / RATE
    first = {each.path: each.first for each in one.report.parameters}
    assert first == pytest.approx({p: 0.01 * abs(value) for p, value in TRUE.items()})


@pytest.mark.parametrize(
    ("changes", "errors", "message"),
    [
        ({}, 0.0, "plant: its standard errors are unknown; a record is designed for a"),
        ({"sensor/noise_rms": 0.0}, 0.01, "sensor.noise_rms is 0; the errors to exp"),
        (
            {"actuator/bandwidth": 1000.0},
            0.01,
            "actuator: records are designed for a plant without an amplifier; leave",
        ),
    ],
)
def test_cases_without_a_design_are_refused(tmp_path, changes, errors, message):
    case = read(write_study(tmp_path, changes, errors))
    with pytest.raises(ValueError, match=message):
        next_record(case, case.loop, GENERATOR, SAMPLES)


def test_a_generator_of_another_rate_is_refused(case):
    other = Generator(-50.0, 50.0, 1e4)
    with pytest.raises(ValueError, match="the rate of the generator is 10000 Hz and t"):
        next_record(case, case.loop, other, SAMPLES)


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Return a folder of tune for the study, and make the search short."""
    monkeypatch.setattr(record_search, "TRIALS", 3)
    monkeypatch.setattr(record_search, "ROUGH", 2)
    monkeypatch.setattr(record_search, "FINE", 2)
    short = {"optimiser": {"starts": 1, "candidates": 2, "steps": 2}}
    study = write_study(tmp_path, short)
    tuned = call("tune", study, "--out", tmp_path / "tuned")
    assert tuned.exit_code in (0, 3), tuned.output
    return tmp_path / "tuned"


def test_the_command_writes_the_record_and_what_it_will_tell(results, tmp_path):
    out = tmp_path / "next"
    options = "--slew", "20000", "--slowest", "20", "--duration", "0.1"
    printed = succeeded(call("excite", results, *options, "--out", out))
    found = read_sampled(out / "record.csv", {"input": "voltage_V"}, time="time_s")
    voltages = found.matrix("input")[:, 0]
    assert found.dt == pytest.approx(1.0 / RATE)
    assert np.ptp(voltages[:500]) == 0.0
    assert np.abs(voltages).max() <= 50.0
    expected = json.loads((out / "expected.json").read_text(encoding="utf-8"))
    page = checked(out / "report.html")
    for figure in expected["figures"]:
        assert f"{figure['value']:.4g}" in page.cells or any(
            f"{figure['value']:.4g} " in cell for cell in page.cells
        )
        assert f"{100 * figure['designed']:.3g}" in page.cells
        assert figure["name"] in printed.output
    assert {each["path"] for each in expected["parameters"]} == set(TRUE)
    _, loop = load_loop(results, accept_unsafe=True)
    assert float(loop.controller.integral) > 0.0


def test_the_command_fills_a_buffer(results, tmp_path):
    out = tmp_path / "next"
    options = "--slowest", "20", "--points", "256"
    succeeded(call("excite", results, *options, "--out", out))
    assert not (out / "record.csv").exists()
    rows = np.loadtxt(out / "designed.csv", delimiter=",", skiprows=1)
    assert len(rows) <= 256
    assert RATE * np.abs(np.diff(rows[:, 1])).max() <= 2e4 * (1.0 + 1e-6)
    plant = tmp_path / "model.json"
    plant.write_text(plant.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    refused = call("excite", results, "--out", tmp_path / "other")
    assert refused.exit_code == 1
    assert "or a file that it names has changed since: the SHA-256 differs" in (
        refused.stderr
    )


def test_the_slew_rate_is_that_of_the_amplifier_or_of_the_record(case):
    assert known_slew(case) == 2e4
    limits = case.study.actuator.model_copy(update={"slew_rate": 3e3})
    study = case.study.model_copy(update={"actuator": limits})
    assert known_slew(dataclasses.replace(case, study=study)) == 3e3
    with pytest.raises(ValueError, match="--slew is missing, and neither the study"):
        known_slew(dataclasses.replace(case, plant_about=pj.About()))


def test_a_record_must_be_longer_than_its_move_back(case):
    slow = dataclasses.replace(GENERATOR, slew=500.0)
    message = "800 samples are too few: the move back to the middle of the range"
    with pytest.raises(ValueError, match=message):
        next_record(case, case.loop, slow, 800)


def test_a_record_without_results_needs_its_limits():
    refused = call("excite", "--lower", "0")
    assert refused.exit_code == 1
    message = "--upper is missing; without RESULTS, give --lower, --upper, --rate"
    assert message in refused.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--duration", "2"), "--duration is that of a designed record; give RESULTS"),
        (
            ("anywhere", "--duration", "2", "--points", "256"),
            "--points and --duration both set the length of a designed record; leave",
        ),
    ],
)
def test_options_of_the_other_kind_of_record_are_refused(options, message):
    refused = call("excite", *options)
    assert refused.exit_code == 1
    assert message in " ".join(refused.stderr.split())
