"""Records of closed loops, made in NumPy: the approaches and their bias."""

import json
from dataclasses import replace
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from oracles import closed_loop as oracle
from oracles import excitation, forty_stages, resonant_records

import piezojax as pj
from piezojax import Record, identify, read_record
from piezojax.cli.identify import main
from piezojax.control import PID, FilteredCommand
from piezojax.core.progress import Silent
from piezojax.core.system import Affine
from piezojax.dynamics import Mode, Notch
from piezojax.identification import Options, average_periods, closed_loop
from piezojax.identification.closed_loop import feedback_warnings
from piezojax.identification.estimators.controlled_stage import (
    ControlledStage,
    loop_drive,
    replayed,
)
from piezojax.identification.estimators.error_problem import problem_of
from piezojax.identification.estimators.free_runs import from_rest
from piezojax.identification.estimators.loop_response import (
    controller_responses,
    loop_response,
)
from piezojax.identification.estimators.noise_model import whitening_filter
from piezojax.identification.estimators.output_error import Optimum
from piezojax.identification.estimators.projection import projected
from piezojax.identification.plausibility import plausibility_warnings
from piezojax.identification.residuals.bound import relative_error
from piezojax.identification.residuals.correlation import autocorrelation
from piezojax.identification.residuals.input_feedback import SHARE, feedback_share
from piezojax.report import fit_pictures
from piezojax.report.fit_pictures import write_model

REST = 50
FAST = oracle.CONTROLLERS["fast PID"]
TRUE = {
    "dynamics.frequency": oracle.FREQUENCY,
    "dynamics.damping": oracle.DAMPING,
    "calibration.gain": oracle.GAIN,
}


def controller_of(gains):
    pid = PID(*gains[:4], dt=oracle.DT)
    if gains.notch is None:
        return pid
    shape = oracle.NOTCH_DAMPING, oracle.NOTCH_DEPTH
    return FilteredCommand(pid, Notch(gains.notch, *shape, oracle.DT))


@cache
def loop(name, samples, seed, reference=0.3, dither=0.0, size=0.005):
    """Return the record of a loop with binary excitations, and its noise."""
    draw = np.random.default_rng(seed)
    r, d = (a * draw.choice([-1.0, 1.0], samples) for a in (reference, dither))
    r[:REST] = d[:REST] = 0.0
    noise = oracle.noise(draw, samples, size) if size else np.zeros(samples)
    u, y = oracle.run(oracle.CONTROLLERS[name], r, d, noise)
    return Record(u, y, oracle.DT, reference=r, dither=d, source=name), noise


def test_the_loop_and_its_parts_are_those_of_the_oracle():
    gains = oracle.Gains(0.5, 500.0, 1e-5, 2e-5, notch=800.0)
    draw = np.random.default_rng(1)
    r, d = (a * draw.choice([-1.0, 1.0], 600) for a in (0.3, 0.5))
    r[:REST] = d[:REST] = 0.0
    u, y = oracle.run(gains, r, d, np.zeros(600))
    record = Record(u, y, oracle.DT, reference=r, dither=d)
    controller = controller_of(gains)
    np.testing.assert_allclose(replayed(controller, record), record.input, atol=1e-9)
    plant = Mode(oracle.FREQUENCY, oracle.DAMPING, oracle.DT) >> Affine(oracle.GAIN)
    stage = ControlledStage(plant, controller, 0.0)
    run = from_rest(stage, jnp.asarray(loop_drive(record)))
    np.testing.assert_allclose(run, record.output, atol=1e-9)
    frequency = np.array([0.0, 20.0, 800.0, 3000.0])
    by_reference, by_output = controller_responses(controller, frequency, oracle.DT)
    exact = oracle.controller_response(gains, frequency[1:])
    np.testing.assert_allclose(by_reference[1:], exact, rtol=1e-9)
    np.testing.assert_allclose(by_output[1:], -exact, rtol=1e-9)
    assert by_reference[0] == by_output[0] == 0.0


def test_a_loop_without_a_reference_starts_at_its_first_output():
    record, _ = loop("slow PI", 600, 1)
    alone = Record(record.input, record.output + 2.0, record.dt, dither=record.input)
    drive = loop_drive(alone)
    assert np.all(drive[:, :2] == alone.output[0])
    assert np.all(drive[:, 2] == record.input)


# Spectral estimates


def mean_response(record, approach, **options):
    found = loop_response(record, approach, segment=512, **options)
    kept = (found.frequency > 30.0) & (found.frequency < 3000.0)
    return found, kept & (np.abs(found.frequency - oracle.FREQUENCY) > 150.0)


@pytest.mark.parametrize(("reference", "dither"), [(0.0, 0.4), (0.2, 0.4)])
def test_the_spectral_estimate_tends_to_its_closed_form_and_the_others_do_not(
    reference, dither
):
    record, _ = loop("PI with notch", 20_000, 3, reference, dither, 0.02)
    gains = oracle.CONTROLLERS["PI with notch"]
    found, kept = mean_response(record, "direct")
    lines = found.frequency[kept]
    biased = oracle.naive_response(gains, lines, reference, dither, 0.02)
    exact = oracle.stage_response(lines)
    deviation = np.sqrt(found.variance[kept])
    values = found.response[kept]
    assert np.median(np.abs(values - biased) / deviation) < 1.2
    far = np.abs(biased - exact) > 4.0 * deviation
    assert far.sum() > 15
    assert np.median((np.abs(values - exact) / deviation)[far]) > 4.0
    for approach in ("indirect", "joint"):
        options = {"controller": controller_of(gains)} if approach[0] == "i" else {}
        found, kept = mean_response(record, approach, **options)
        exact = oracle.stage_response(found.frequency[kept])
        error = np.abs(found.response[kept] - exact) / np.sqrt(found.variance[kept])
        assert np.median(error) < 1.5
        # The mean of a complex error of unit power is 0.89 of its root.
        assert np.sqrt(np.mean(error**2)) == pytest.approx(1.0, abs=0.35)


def test_a_periodic_reference_gives_the_exact_response():
    period = 400
    tones = np.random.default_rng(5).standard_normal(period)
    tones -= tones.mean()
    r = np.tile(tones, 14)
    u, y = oracle.run(FAST, r, np.zeros(r.size), np.zeros(r.size))
    record = Record(u, y, oracle.DT, reference=r, period=period)
    late = record.during(slice(10 * period, None))
    found = loop_response(late, "joint")
    exact = oracle.stage_response(found.frequency)
    np.testing.assert_allclose(found.response, exact, rtol=1e-3)


@pytest.mark.parametrize(
    ("approach", "changes", "message"),
    [
        ("spectral", {}, "approach 'spectral' is unknown; there are direct, indirect"),
        ("indirect", {}, "indirect needs the controller of the loop"),
        ("joint", {"reference": np.ones(600)}, "never change: they excite nothing"),
    ],
)
def test_spectral_estimates_that_are_refused(approach, changes, message):
    record, _ = loop("slow PI", 600, 1)
    with pytest.raises(ValueError, match=message):
        loop_response(replace(record, **changes), approach)


# Parts without noise, noise models, feedback


def test_the_part_that_responds_to_the_excitation():
    noisy, _ = loop("fast PID", 2500, 7, dither=1.0)
    clean, _ = oracle.run(FAST, noisy.reference, noisy.dither, np.zeros(2500))
    found = projected(noisy.input, noisy.excitation)
    share = np.var(found - clean) / np.var(noisy.input - clean)
    assert share < 0.1
    exact = projected(clean + 5.0, noisy.excitation) - 5.0
    np.testing.assert_allclose(exact, clean, atol=1e-3 * np.std(clean))
    with pytest.raises(ValueError, match="100 samples; the response to the"):
        projected(noisy.input[:100], noisy.excitation[:100])


def test_a_drift_that_the_excitation_does_not_cause_is_left_out():
    random = np.random.default_rng(4)
    excitation = np.sin(0.1 * np.arange(3000))[:, None]
    response = 0.01 * excitation[:, 0]
    drift = 0.01 * np.cumsum(random.standard_normal(3000))
    found = projected(response + drift, excitation)
    assert np.mean(found) == pytest.approx(np.mean(drift + response))
    late = slice(1500, None)
    assert np.std(found[late]) < 0.2 * np.std((drift + response)[late])


def test_strongly_coloured_noise_becomes_white():
    noise = oracle.noise(np.random.default_rng(1), 3000, 1.0)
    filtered = np.convolve(noise, whitening_filter([noise[:1500], noise[1500:]]))
    assert not autocorrelation(filtered[20:3000]).significant
    assert np.std(filtered[20:3000]) == pytest.approx(1.0, rel=0.05)
    assert np.all(whitening_filter([noise[:30]])[1:] == 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_rounded_multisine_is_not_made_by_feedback(seed):
    # Its 60 lines need 120 past samples; 9 digits of them are saved.
    random, time = np.random.default_rng(seed), 1e-4 * np.arange(4000)
    phases = random.uniform(0.0, 2.0 * np.pi, 60)
    turns = np.outer(time, np.geomspace(20.0, 4000.0, 60))
    lines = np.sin(2.0 * np.pi * turns + phases).sum(axis=1)
    voltage = np.round(50.0 + 0.5 * lines / np.abs(lines).max(), 7)
    w = 2.0 * np.pi * 780.0
    mode = [0.4 * w**2], [1.0, 0.04 * w, w**2]
    b, a, _ = scipy.signal.cont2discrete(mode, 1e-4)
    moved = scipy.signal.lfilter(b[0], a, voltage - voltage[0])
    moved += 2e-3 * random.standard_normal(time.size)
    assert feedback_share(voltage, moved) == 0.0


def test_feedback_is_seen():
    record, noise = loop("fast PID", 2000, 2, reference=0.1)
    assert feedback_share(record.input, record.output) > SHARE
    open_output = oracle.open_run(record.input[::-1], noise)
    assert feedback_share(record.input[::-1], open_output) == 0.0
    assert feedback_share(record.input[:999], record.output[:999]) == 0.0


def test_an_output_that_was_smoothed_looking_ahead_is_seen():
    case = resonant_records.grid()[0]._replace(seconds=0.5)
    input, output = resonant_records.measured(case)
    assert feedback_share(input, output) == 0.0
    low_pass = scipy.signal.butter(4, 0.12, output="sos")
    smoothed = scipy.signal.sosfiltfilt(low_pass, output)
    record = Record(input, smoothed, 1.0 / resonant_records.RATE, source="bench.csv")
    (alarm,), notes = feedback_warnings([record], slice(0, record.samples))
    assert alarm.startswith("bench.csv: past outputs explain ")
    assert "smoothed by a filter that looks ahead, which hides resonances" in alarm
    assert notes == []
    # A voltage without noise is predicted so well that past outputs help a little.
    slow = forty_stages.stage(3)
    drive, moved = excitation.record(slow)
    record = Record(drive, moved, slow.dt, source="slow.csv")
    alarms, notes = feedback_warnings([record], slice(0, record.samples // 2))
    assert (alarms, len(notes)) == ([], 1)


def test_open_loops_with_hysteresis_are_not_taken_for_feedback():
    for case in resonant_records.grid()[:5:2]:
        input, output = resonant_records.measured(case._replace(seconds=0.2))
        assert feedback_share(input, output) == 0.0
    ramp = np.arange(1000.0)
    assert feedback_share(ramp, np.sin(ramp)) == 0.0


def test_one_uneven_stretch_is_not_taken_for_feedback():
    sizes = np.repeat([1e-3] * 9 + [1.0], 1000)
    for seed in range(12):
        input, output = np.random.default_rng([5, seed]).standard_normal((2, 10_000))
        assert feedback_share(sizes * input, output) == 0.0


def test_the_columns_of_a_noisy_loop_are_plausible():
    record, _ = loop("PI with notch", 4000, 2)
    assert plausibility_warnings(record) == []


def test_the_error_bound_of_a_loop_is_that_of_the_stage():
    record, _ = loop("PI with notch", 16_000, 4, size=0.01)
    exact = oracle.open_run(record.input, np.zeros(record.samples))
    every = slice(0, record.samples)
    found = relative_error(record, exact, every)
    assert np.mean(found.error <= found.margin) > 0.97
    assert not np.any(found.sure)
    naive = replace(record, reference=None, dither=None)
    assert relative_error(naive, exact, every).sure.sum() > 5
    wrong = relative_error(record, 1.5 * exact, every)
    certain = wrong.margin < 0.3
    assert certain.sum() > 20
    assert np.median(wrong.error[certain]) == pytest.approx(1.0 / 3.0, abs=0.1)


def slow_loop(seed, top=150.0, samples=3000, dt=1e-4):
    """Return the record of a slow loop under sines up to ``top`` Hz, and its model.

    The voltage contains more noise than response to them.
    """
    random = np.random.default_rng(seed)
    time = dt * np.arange(samples)
    sines = np.linspace(10.0, top, 15)
    phases = random.uniform(0.0, 2.0 * np.pi, 15)
    reference = np.sum(np.sin(2.0 * np.pi * sines * time[:, None] + phases), axis=1)
    noise = 0.05 * random.standard_normal(samples)
    output, input = np.zeros((2, samples))
    for k in range(samples):
        input[k] = input[k - 1] + 0.2 * (reference[k] - output[k] - noise[k])
        if k + 1 < samples:
            output[k + 1] = 0.9 * output[k] + 0.01 * input[k]
    return Record(input, output + noise, dt, reference=reference), output


@pytest.mark.parametrize("seed", range(8))
def test_lines_that_the_reference_does_not_excite_show_no_error(seed):
    """There the error is noise, and the response of the model is nearly zero."""
    record, model = slow_loop(seed)
    found = relative_error(record, model, slice(1500, 3000))
    assert found.frequency.min() < 100.0
    assert found.frequency.max() < 400.0
    assert not np.any(found.sure)


# Fits


SAMPLES = 1550


@cache
def fit(approach, closed=True):
    record, _ = loop("fast PID", SAMPLES, 4, reference=0.15)
    if not closed:
        record = replace(record, reference=None, dither=None)
    return identify(
        record,
        "mode",
        train=slice(0, SAMPLES - 50),
        options=Options(closed_loop=approach),
    )


def errors(found):
    """Return the errors of the mode in standard errors."""
    parameters = found.report.parameters
    return np.array(
        [
            (parameters[path].value - true) / parameters[path].standard_error
            for path, true in TRUE.items()
        ]
    )


def test_a_fit_to_a_record_with_a_reference_is_unbiased():
    found = fit(None)
    assert np.all(np.abs(errors(found)) < 3.0)
    assert found.report.closed_loop.startswith("direct")
    assert not [text for text in found.report.warnings if "feedback" in text]


def test_a_fit_for_open_loops_is_biased_and_says_so():
    found = fit(None, closed=False)
    assert errors(found)[2] < -5.0
    assert found.report.closed_loop == ""
    (warning,) = [text for text in found.report.warnings if "feedback" in text]
    assert "past outputs explain" in warning
    assert "biased towards -1 / controller" in warning


def test_noise_that_the_model_does_not_whiten_leads_to_joint():
    record, _ = loop("fast PID", SAMPLES, 4)
    white = 0.06 * np.random.default_rng(3).standard_normal(SAMPLES + 23)
    echo = white[23:] - 0.9 * white[:-23]
    u, y = oracle.run(FAST, record.reference, np.zeros(SAMPLES), echo)
    found = identify(
        replace(record, inputs=u, outputs=y), "mode", train=slice(0, SAMPLES - 50)
    )
    assert found.report.closed_loop.startswith("joint")
    assert "does not whiten the prediction errors" in found.report.closed_loop
    for path, true in TRUE.items():
        off = 0.15 if path.endswith("damping") else 0.03
        assert found.report.parameters[path].value == pytest.approx(true, rel=off)
        # Nothing tells how much the first stage adds to the scatter.
        assert found.report.parameters[path].standard_error is None


def test_indirect_simulates_the_loop_under_its_controller(monkeypatch):
    """At the true stage the errors are those of the oracle: none without noise."""
    record, _ = loop("slow PI", 1000, 4, size=0.0)
    controller = controller_of(oracle.CONTROLLERS["slow PI"])

    def at_the_truth(structure, records, train, *, drives, **options):
        assert options["noise_model"]
        problem = problem_of(structure, records, train, drives)
        values = {f"plant.{path}": true for path, true in TRUE.items()}
        values["plant.calibration.offset"] = 0.0
        point = jnp.array([values[path] for path in structure.space.paths])
        unit = np.asarray(structure.space.to_unit(point))
        return Optimum(problem, unit[None], np.zeros(1), True)

    monkeypatch.setattr(closed_loop, "output_error", at_the_truth)

    def fitted(controller):
        options = Options(closed_loop="indirect", controller=controller)
        every = slice(0, record.samples)
        return closed_loop.loop_fit("mode", [record], every, options, Silent())

    found = fitted(controller)
    problem, unit = found.optimum.problem, jnp.asarray(found.optimum.units[0])
    assert np.max(np.abs(problem.errors(unit))) < 1e-6
    assert float(found.system.parts[1].gain) == pytest.approx(oracle.GAIN)
    assert found.inside == "plant."
    assert found.warnings == []
    weaker = eqx.tree_at(lambda c: c.integral, controller, 0.8 * controller.integral)
    (warning,) = fitted(weaker).warnings
    assert "the controller does not explain the recorded voltage" in warning


@pytest.fixture
def unfitted(monkeypatch):
    """Replace a fit by its starts."""

    def starts(structure, records, train, **_):
        problem = problem_of(structure, records, train)
        return Optimum(problem, structure.starts, np.zeros(1), True)

    monkeypatch.setattr(closed_loop, "output_error", starts)


@pytest.mark.usefixtures("unfitted")
@pytest.mark.parametrize(("reference", "noisy"), [(0.05, True), (3.0, False)])
def test_joint_warns_where_noise_drives_the_input(reference, noisy):
    record, _ = loop("slow PI", 1500, 4, reference=reference)
    every = slice(0, record.samples)
    options = Options(closed_loop="joint")
    found = closed_loop.loop_fit("mode", [record], every, options, Silent())
    assert not found.scatter_known
    assert share_warnings(found) == noisy


def share_warnings(found):
    """Return how many warnings of a fit name the share of the noise."""
    return sum("keeps a share of the noise" in text for text in found.warnings)


@pytest.mark.usefixtures("unfitted")
def test_samples_after_the_training_part_do_not_hide_the_noise():
    quiet, _ = loop("slow PI", 1500, 4, reference=0.05)
    later, _ = loop("slow PI", 1500, 5, reference=3.0)
    signals = ("inputs", "outputs", "reference", "dither")
    both = [np.concatenate([getattr(r, s) for r in (quiet, later)]) for s in signals]
    columns = dict(zip(signals, both, strict=True))
    record = replace(quiet, **columns)
    options = Options(closed_loop="joint")
    train = slice(0, quiet.samples)
    found = closed_loop.loop_fit("mode", [record], train, options, Silent())
    assert share_warnings(found) == 1


def test_the_command_fits_a_loop(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The pictures of a fit have tests of their own.
    monkeypatch.setattr(
        fit_pictures, "write_fit", lambda fit, folder: write_model(fit, folder) or {}
    )
    record, _ = loop("fast PID", SAMPLES, 4, reference=0.15)
    columns = [record.time, record.input, record.output, 1e3 * record.reference]
    head = "time_s,drive_V,sensor_um,reference_nm"
    table = np.stack(columns, axis=1)
    np.savetxt("bench.csv", table, "%.12g", ",", header=head, comments="")
    names = "--time time_s --input drive_V --output sensor_um --reference reference_nm"
    line = f"bench.csv {names} --model mode --closed-loop direct --out found"
    done = CliRunner().invoke(main, f"{line} --train 0:{SAMPLES - 50}".split())
    assert done.exit_code == 0, done.output
    assert "reference from -0.15 to 0.15 um" in done.output
    assert "closed loop: direct, prediction error with a noise model" in done.output
    report = json.loads((tmp_path / "found" / "fit.json").read_text())
    assert report["closed_loop"].startswith("direct")
    for path, one in fit(None).report.parameters.items():
        assert report["parameters"][path]["value"] == pytest.approx(one.value, rel=1e-3)
    line = line.replace("direct", "indirect") + "2 --loop-controller none.toml"
    refused = CliRunner().invoke(main, line.split())
    assert refused.exit_code == 1
    assert "--loop-controller 'none.toml' is neither a file nor one" in refused.output
    pj.save(PI, "gains.toml")
    pi = line.replace("none.toml", "gains.toml").replace("indirect", "joint")
    refused = CliRunner().invoke(main, pi.split())
    assert refused.exit_code == 1
    assert "indirect needs the controller of the loop, and no other" in refused.output


PI = PID(0.1, 10.0, dt=oracle.DT)


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        ("mode", Options(closed_loop="two"), "closed_loop 'two' is unknown; there are"),
        (
            "mode",
            Options(closed_loop="indirect"),
            "indirect needs the controller of the loop, and no other approach",
        ),
        (
            "mode",
            Options(closed_loop="joint", controller=PI),
            "indirect needs the controller of the loop, and no other approach",
        ),
        (
            "mode",
            Options(
                closed_loop="indirect", controller=PID(0.1, 10.0, dt=2.0 * oracle.DT)
            ),
            "the controller runs at 5000 Hz and slow PI at 10000 Hz; they must be",
        ),
        (
            "coleman_hodgdon+lag",
            Options(closed_loop="joint"),
            "joint takes the input as a linear response to the reference, and behind",
        ),
        (
            "state_space",
            Options(closed_loop="direct"),
            "the method for 'state_space' is for open loops; output_error fits",
        ),
    ],
)
def test_fits_that_are_refused(model, options, message):
    record, _ = loop("slow PI", 600, 1)
    with pytest.raises(ValueError, match=message):
        identify(record, model, options=options)


def test_records_that_suit_no_approach_are_refused():
    record, _ = loop("slow PI", 600, 1)
    quiet = replace(record, reference=np.full(600, 3.0), dither=None)
    for approach, more in (("joint", None), ("indirect", PI)):
        options = Options(closed_loop=approach, controller=more)
        with pytest.raises(
            ValueError, match=f"slow PI: {approach} needs the reference"
        ):
            identify(quiet, "mode", options=options)
    options = Options(closed_loop="indirect", controller=PI)
    with pytest.raises(ValueError, match="2 records; indirect takes one"):
        identify([record, record], "mode", options=options)


# Records


def test_reference_and_dither_are_read_and_cut_with_the_record(tmp_path):
    record, _ = loop("slow PI", 600, 1, dither=0.5)
    columns = [record.input, record.output, 1e3 * record.reference, record.dither]
    head = "drive_V,sensor_um,wanted_nm,added"
    path = tmp_path / "r.csv"
    np.savetxt(path, np.stack(columns, 1), "%.12g", ",", header=head, comments="")
    options = {"rate": oracle.RATE, "reference": "wanted_nm", "dither": 3}
    found = read_record(path, **options)
    np.testing.assert_allclose(found.reference, record.reference, atol=1e-9)
    np.testing.assert_allclose(found.dither, record.dither, atol=1e-9)
    assert found.closed_loop
    assert found.excitation.shape == (600, 2)
    part = found.until(500).during(slice(100, None))
    np.testing.assert_array_equal(part.reference, found.reference[100:500])
    converted = found.in_units(("mV",), ("nm",))
    np.testing.assert_allclose(converted.reference, 1e3 * found.reference)
    np.testing.assert_allclose(converted.dither, 1e3 * found.dither)
    mean = average_periods(replace(found, period=200))
    thirds = found.reference.reshape(3, 200)[1:]
    np.testing.assert_allclose(mean.reference, thirds.mean(axis=0))
    assert not read_record(path, rate=oracle.RATE).closed_loop
    with pytest.raises(ValueError, match="reference column 'none' is missing; there"):
        read_record(path, rate=oracle.RATE, reference="none")
    with pytest.raises(ValueError, match="'drive_V' is in V, and um is needed"):
        read_record(path, rate=oracle.RATE, input=3, reference="drive_V")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reference": np.ones(599)}, r"reference has shape \(599,\); it must be"),
        (
            {"dither": np.full(600, np.nan)},
            "dither is missing or not finite at sample 0",
        ),
        (
            {
                "inputs": np.random.default_rng(0).standard_normal((600, 2)),
                "input_units": ("V", "V"),
            },
            "a record with a reference must have one input and one output",
        ),
    ],
)
def test_records_that_are_refused(changes, message):
    record, _ = loop("slow PI", 600, 1)
    with pytest.raises(ValueError, match=message):
        replace(record, **changes)
