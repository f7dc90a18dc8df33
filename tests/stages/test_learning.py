"""A reference learned on a stage: what it reaches, and how it ends."""

import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import call, succeeded
from stages.stage_in_tests import (
    DT,
    REFERENCE,
    SAFE,
    STUDY,
    lag,
    served,
    stage,
    write_study,
)

import piezojax as pj
from piezojax.cli.on_stage import tuned_gains
from piezojax.control import PID
from piezojax.core.error_bound import ErrorBound
from piezojax.hardware import Saturation, Sensor
from piezojax.stages import Fault, LostError, Motion, StoppedError
from piezojax.stages.learning import (
    LARGEST,
    LearningFilter,
    LearnReport,
    learn_reference,
    learning_filter,
)

GAINS = {"proportional": 1.0, "integral": 800.0}
MOTION = Motion("SIN2", REFERENCE, None, 100, 1e-3)


def loop(plant=None):
    controller = PID(*GAINS.values(), 0.0, dt=DT)
    limits = Saturation(-10.0, 110.0)
    return pj.Feedback(controller, plant or lag(), limits, Sensor(0.0))


def known(relative):
    lines = np.array([0.0, 500.0])
    return ErrorBound(
        frequency=lines.tolist(), relative=[relative] * 2, excited=[True] * 2
    )


@pytest.fixture(scope="module")
def law():
    return learning_filter(loop(), 6.0, DT, known(0.05))


def learned(one, law, folder, runs=6, **options):
    return learn_reference(one, GAINS, MOTION, law, folder, runs=runs, **options)


@pytest.mark.parametrize("frequency", [2.0, 10.0, 20.0])
def test_the_filter_inverts_the_closed_loop(frequency):
    """Against the response to a sine, simulated until it is periodic."""
    found = learning_filter(loop(), 6.0, DT, known(1e-6))
    time = DT * np.arange(4000)
    reference = 3.0 + np.sin(2.0 * np.pi * frequency * time)
    system = loop()
    log = pj.simulate(system, pj.loop_inputs(jnp.asarray(reference)), system.init(3.0))
    turning = np.exp(-2j * np.pi * frequency * time)[2000:]
    wanted, followed = (
        np.sum((np.asarray(x)[2000:] - 3.0) * turning)
        for x in (reference, log[1].displacement)
    )
    gain = np.interp(frequency, found.frequency, np.real(found.gain))
    gain = gain + 1j * np.interp(frequency, found.frequency, np.imag(found.gain))
    assert gain == pytest.approx(wanted / followed, rel=0.01)


def test_what_is_not_known_is_not_corrected():
    sizes = [
        np.abs(learning_filter(loop(), 6.0, DT, known(relative)).gain)
        for relative in (0.01, 0.5, 25.0)
    ]
    # At 0 Hz the loop suppresses any error of its plant.
    assert sizes[2][0] == pytest.approx(sizes[0][0], rel=1e-3)
    above = np.argmax(np.abs(np.asarray(sizes[0]) > 1.5))
    assert np.all(sizes[0] >= sizes[1])
    assert np.all(sizes[1] >= sizes[2])
    assert np.max(sizes[2][above:]) < 0.05
    assert np.max(sizes[0]) == pytest.approx(LARGEST)
    without = learning_filter(loop(), 6.0, DT)
    np.testing.assert_allclose(
        without.gain, learning_filter(loop(), 6.0, DT, known(0.3)).gain
    )


def test_a_correction_leads_a_delayed_error():
    """A filter of two samples of lead, and nothing from beyond the ends."""
    frequency = np.fft.rfftfreq(4096, DT)
    lead = LearningFilter(frequency, np.exp(2j * np.pi * frequency * 2.0 * DT))
    error = np.zeros(300)
    error[[1, 150, 299]] = 1.0
    found = lead.correction(error, DT)
    assert found[[148, 297]] == pytest.approx([1.0, 1.0], abs=1e-3)
    rest = np.delete(found, [148, 297])
    assert np.max(np.abs(rest)) < 1e-3


def test_noise_is_not_learned():
    frequency = np.fft.rfftfreq(4096, DT)
    law = LearningFilter(frequency, np.ones(len(frequency), complex))
    wave = 0.05 * np.sin(2.0 * np.pi * 20.0 * DT * np.arange(2000))
    noise = 0.01 * np.random.default_rng(1).standard_normal(2000)
    found = law.correction(wave + noise, DT, 0.01)
    assert np.std(found - wave) < 0.5 * np.std(noise)
    np.testing.assert_allclose(law.correction(wave + noise, DT), wave + noise)


def test_the_error_falls_on_a_stage_that_is_not_the_model(law, tmp_path):
    one = stage(plant=lag(0.085), seed=2)
    one.apply({"integral": 650.0})
    report = learned(one, law, tmp_path, points=100)
    errors = [run.measured_um for run in report.runs]
    assert report.verdict == "done"
    assert not report.alarms
    assert errors[0] > 0.2
    assert report.ratio > 20.0
    # What is left is the noise of the sensor.
    assert errors[report.best] < 3e-3
    assert one.gains()["integral"] == 650.0
    assert report == LearnReport.model_validate_json(
        (tmp_path / "learn.json").read_text()
    )
    table = np.loadtxt(tmp_path / "learned.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 1], REFERENCE, atol=1e-5)
    # A plain run of this stage with the learned reference, without noise.
    system = loop(lag(0.085))
    log = pj.simulate(
        system, pj.loop_inputs(jnp.asarray(table[:, 2])), system.init(table[0, 2])
    )
    error = (np.asarray(log[1].displacement) - REFERENCE)[100:]
    assert np.sqrt(np.mean(error**2)) < 3e-3
    points = np.loadtxt(tmp_path / "table.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(points, table[::10, [0, 2]], atol=1e-6)


def test_it_ends_when_the_error_falls_no_more(law, tmp_path):
    report = learned(stage(seed=3), law, tmp_path, runs=30)
    assert len(report.runs) < 12
    errors = [run.measured_um for run in report.runs]
    assert errors[report.best] == min(errors)
    assert report.verdict == "done"


def test_corrections_are_cut(tmp_path):
    wild = LearningFilter(np.array([0.0, 500.0]), np.array([5.0 + 0j, 5.0]))
    one = stage(seed=4)
    report = learned(one, wild, tmp_path)
    assert report.notes == ["corrections are cut at 0.6 um, a tenth of the motion"]
    table = np.loadtxt(tmp_path / "learned.csv", delimiter=",", skiprows=1)
    assert np.max(np.abs(table[:, 2] - table[:, 1])) <= 0.6 + 1e-6


def test_a_run_that_is_stopped_ends_with_the_safe_gains(law, tmp_path):
    one = stage()
    whole, count = one.run, []

    def run(reference, gains):
        count.append(reference)
        if len(count) == 3:
            one.faults = [Fault("stuck", 300, 900)]
        return whole(reference, gains)

    one.run = run
    report = learned(one, law, tmp_path)
    assert report.verdict == "stopped"
    assert report.alarms[0].startswith("run 3: the ")
    assert report.alarms[0].endswith("; the safe gains of the stage are set")
    assert report.best == 1
    assert one.gains() | SAFE == one.gains()
    assert (tmp_path / "learned.csv").exists()


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (KeyboardInterrupt(), "stopped"),
        (LostError("the connection to the stage is lost"), "lost"),
        (RuntimeError("the driver failed"), "stopped"),
    ],
)
def test_every_failure_ends_with_an_alarm(law, tmp_path, error, verdict):
    one = stage()
    whole, count = one.run, []

    def run(reference, gains):
        count.append(reference)
        if len(count) == 2:
            raise error
        return whole(reference, gains)

    one.run = run
    if isinstance(error, LostError):
        learned(one, law, tmp_path)
    else:
        with pytest.raises(type(error)):
            learned(one, law, tmp_path)
    report = LearnReport.model_validate_json((tmp_path / "learn.json").read_text())
    assert report.verdict == verdict
    assert report.alarms
    assert len(report.runs) == 1
    if verdict == "stopped":
        assert one.gains() | SAFE == one.gains()


def test_gains_that_the_stage_lacks_are_refused(law, tmp_path):
    with pytest.raises(ValueError, match="speed"):
        learn_reference(stage(), {"speed": 1.0}, MOTION, law, tmp_path, runs=3)


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuned")
    study = write_study(folder, optimiser={"starts": 1, "candidates": 2, "steps": 1})
    succeeded(call("tune", study, "--out", folder / "results"))
    return folder / "results"


def commanded(tuned, address, *more):
    return call("learn", tuned, "--stage", address, *more)


def test_the_command_writes_a_page(tuned, tmp_path):
    out = tmp_path / "out"
    with served(stage(plant=lag(0.09))) as address:
        printed = succeeded(
            commanded(tuned, address, "--out", out, "--runs", "4", "--points", "50")
        ).stdout
    assert "runs of SIN2: error with noise" in printed
    assert "times smaller; the reference of run" in printed
    assert "the stage has the gains from before" in printed
    assert (out / "learn.png").stat().st_size > 20_000
    assert "learning SIN2 on 127.0.0.1" in (out / "report.html").read_text()
    assert len(json.loads((out / "learn.json").read_text())["runs"]) <= 4
    assert len((out / "table.csv").read_text().splitlines()) == 51


def test_the_named_study_leads_to_its_trajectories(tuned, tmp_path):
    """Results that were moved do not find them."""
    table = np.c_[DT * np.arange(len(REFERENCE)), REFERENCE]
    head = "time_s,z_um"
    np.savetxt(tmp_path / "scan.csv", table, delimiter=",", header=head, comments="")
    scan = {"file": "scan.csv", "time": "time_s", "column": "z_um"}
    references = STUDY["references"] | {"tune": ["scan"], "files": {"scan": scan}}
    named, moved = write_study(tmp_path, references=references), tmp_path / "moved"
    shutil.copytree(tuned, moved)
    shutil.copy(named, moved / "study.toml")
    result = moved / "result.json"
    result.write_text(result.read_text().replace('"SIN2"', '"scan"'))
    with pytest.raises(ValueError, match=r"scan\.csv"):
        tuned_gains(moved)
    motion, *_ = tuned_gains(moved, named)[2]
    np.testing.assert_allclose(motion.reference, REFERENCE, atol=1e-9)
    (tmp_path / "other").mkdir()
    with pytest.raises(ValueError, match=r"study\.toml has no reference scan: it"):
        tuned_gains(moved, write_study(tmp_path / "other"))


def test_an_unknown_reference_is_refused(tuned):
    result = commanded(tuned, "127.0.0.1:1", "--reference", "SIN3")
    assert result.exit_code == 1
    assert "--reference is 'SIN3'; the study has SIN2, SIN4" in result.stderr


def test_the_command_ends_with_the_alarm(tuned, tmp_path):
    one = stage()

    def run(reference, gains):
        raise StoppedError("the tracking error is too large", *[reference[:500]] * 3)

    one.run = run
    with served(one) as address:
        result = commanded(tuned, address, "--out", tmp_path / "out")
    assert result.exit_code == 3
    assert "ALARM: run 1: the tracking error is too large" in result.stdout
    assert "no run was completed; the stage has its safe gains" in result.stdout
