"""A retuning on a stage: what it improves, what it takes back, and what it leaves."""

import inspect
import json
import re
from dataclasses import replace as replace_limits
from types import SimpleNamespace

import numpy as np
import pytest
from small_runs import call, main_of, succeeded
from stages.stage_in_tests import (
    DT,
    LIMITS,
    SAFE,
    STUDY,
    lag,
    served,
    stage,
    write_study,
)

import piezojax as pj
from piezojax.core.paths import replace, scalars
from piezojax.core.progress import Silent
from piezojax.core.serial import save
from piezojax.core.temporaries import claimed
from piezojax.dynamics import FractionalDelay
from piezojax.report.retune_report import write_retuning
from piezojax.stages import Fault, LostError, TriedRun
from piezojax.stages.run_files import run_file, save_samples
from piezojax.stages.try_gains import Motion
from piezojax.tuning import retuning
from piezojax.tuning.attempts import RETUNE_FILE, Attempt, RetuneReport
from piezojax.tuning.retuning import retune
from piezojax.tuning.stage_bench import Bench

GOOD = {"proportional": 4.0, "integral": 2500.0}
WORSE = {"proportional": 0.5, "integral": 400.0}
WILD = {"proportional": 150.0, "integral": 900.0}
SLOW = {"proportional": 0.0, "integral": 60.0}


@pytest.fixture
def study(tmp_path):
    return write_study(tmp_path)


@pytest.fixture
def scripted(monkeypatch):
    """Let the searches return the given gains, predictions and alarms in turn."""

    def use(*found):
        rows = iter(found)
        studies = []

        def tuned(case, **_):
            studies.append(case.study)
            gains, predicted, *alarms = next(rows)
            if gains is None:
                raise predicted or KeyboardInterrupt
            controller = replace(case.loop.controller, gains)
            result = SimpleNamespace(
                status="converged",
                alarms=alarms,
                holdout=SimpleNamespace(per_reference_rms_um={"SIN2": predicted}),
            )
            about = pj.About()
            return SimpleNamespace(
                result=result, controller=controller, case=case, about=about
            )

        def fitted(plant, records, small, file):
            save(plant.system, file, plant.about)

        monkeypatch.setattr(retuning, "tune", tuned)
        monkeypatch.setattr(retuning, "_fit_again", fitted)
        return studies

    return use


def read(folder):
    return RetuneReport.model_validate_json((folder / RETUNE_FILE).read_text())


def out(folder):
    path = folder / "out"
    path.mkdir(exist_ok=True)
    return path


def failing_at(one, run, act):
    """Call ``act`` before the run of this number, from 1."""
    whole, count = one.run, iter(range(1, 100))

    def run_or_fail(reference, gains):
        if next(count) == run:
            act()
        return whole(reference, gains)

    one.run = run_or_fail
    return one


def raising(error):
    def act():
        raise error

    return act


def test_the_error_on_another_stage_falls(study, tmp_path):
    """Gain and lag of the stage are not those of the model."""
    one = stage(plant=lag(0.07), seed=5)
    report = retune(study, one, out(tmp_path), runs=5)
    assert report.verdict == "done"
    assert not report.alarms
    assert report.ratio > 3.0
    best = report.attempts[report.best]
    assert best.model
    assert one.gains() == pytest.approx(best.gains)
    kept = pj.load(tmp_path / "out" / "gains.toml")
    assert scalars(kept) == pytest.approx(best.gains)
    # The model is that of this stage by now, and so is the prediction.
    found = json.loads((tmp_path / "out" / best.model).read_text())
    gain = found["parts"][-1]["gain"]
    assert gain == pytest.approx(0.07, rel=0.02)
    assert best.measured_um == pytest.approx(best.predicted_um, rel=0.3)
    assert len(report.runs) <= 5
    assert read(tmp_path / "out") == report


def test_better_gains_are_kept_and_others_taken_back(study, tmp_path, scripted):
    studies = scripted((GOOD, 0.05), (WORSE, 0.01), (WORSE, 0.01), (GOOD, 0.0))
    one = stage()
    one.apply({"proportional": 1.0, "integral": 900.0})
    report = retune(study, one, out(tmp_path), runs=20)
    assert [attempt.verdict for attempt in report.attempts] == [
        "measured",
        "better",
        "not better",
        "not better",
    ]
    assert report.best == 1
    assert one.gains() | GOOD == one.gains()
    assert report.before | {"proportional": 1.0, "integral": 900.0} == report.before
    assert [run.reference for run in report.runs] == ["small motion", "SIN2"] * 4
    # The box is around the best gains, and shrinks with every attempt that fails.
    boxes = [study.parameters["controller.integral"] for study in studies]
    assert [box.start for box in boxes] == [900.0, 2500.0, 2500.0]
    factors = [box.upper / box.start for box in boxes]
    assert factors[0] == pytest.approx(10.0)
    assert factors[1] > factors[2] > 1.5 - 1e-9
    measured = report.attempts[0]
    with np.load(tmp_path / "out" / report.runs[1].file) as samples:
        error = (samples["reference_um"] - samples["measured_um"])[500:]
    assert measured.measured_um == pytest.approx(np.sqrt(np.mean(error**2)))


def test_the_factor_grows_while_predictions_hold(study, tmp_path, scripted):
    first = {"proportional": 2.0, "integral": 1500.0}
    for name, predicted, factor in (("right", 0.18, 25.0), ("wrong", 0.05, 10.0**0.5)):
        folder = tmp_path / name
        folder.mkdir()
        studies = scripted((first, predicted), (GOOD, 0.05))
        report = retune(study, stage(), folder, runs=6)
        assert report.attempts[1].verdict == "better"
        assert report.attempts[1].measured_um == pytest.approx(0.18, rel=0.1)
        boxes = [study.parameters["controller.proportional"] for study in studies]
        # A factor of 100 would leave the box of the study, which ends at 50.
        assert boxes[1].upper / boxes[1].start == pytest.approx(factor)


def test_gains_with_an_alarm_are_not_tried(study, tmp_path, scripted):
    scripted((GOOD, 0.01, "the loop is unstable"))
    one = stage()
    before = one.gains()
    report = retune(study, one, out(tmp_path))
    assert [run.reference for run in report.runs] == ["small motion", "SIN2"]
    assert report.attempts[1].verdict == "not tried"
    assert report.notes == ["model_1.json: not tried: the loop is unstable"]
    assert one.gains() == before


def test_a_search_that_fails_leaves_the_best_gains_and_a_note(
    study, tmp_path, scripted
):
    scripted((GOOD, 0.05), (None, ValueError("the loop diverges at all points tried")))
    one = stage()
    report = retune(study, one, out(tmp_path), runs=8)
    assert report.verdict == "done"
    files = "run_01.npz, run_02.npz, run_03.npz, run_04.npz"
    assert report.notes == [
        f"no gains suit the plant of {files}: the loop diverges at all points tried"
    ]
    assert one.gains() | GOOD == one.gains()
    assert read(tmp_path / "out") == report


@pytest.mark.parametrize("changed", [{}, {"derivative_filter": 100.0}])
def test_a_gain_that_the_stage_lacks_must_not_change(
    study, tmp_path, scripted, changed
):
    scripted((GOOD | changed, 0.05), (WORSE, 5.0))
    one = stage()
    whole = one.gains
    one.gains = lambda: {
        path: value for path, value in whole().items() if path != "derivative_filter"
    }
    report = retune(study, one, out(tmp_path))
    assert "derivative_filter" not in report.attempts[1].gains
    if changed:
        assert report.attempts[1].why == (
            "the design changes derivative_filter, and the stage has no such gain"
        )
    else:
        assert report.attempts[1].verdict == "better"


def test_no_expected_improvement_ends_it(study, tmp_path, scripted):
    """The first tuned gains are run in any case: they show what the start hides."""
    scripted((GOOD, 5.0), (GOOD, 5.0))
    report = retune(study, stage(), out(tmp_path))
    assert report.attempts[1].verdict == "better"
    assert report.attempts[2].why == "no improvement is expected"
    assert len(report.runs) == 4


def test_gains_that_are_stopped_are_taken_back(study, tmp_path, scripted):
    scripted((WILD, 0.01), (GOOD, 0.05))
    one = stage()
    report = retune(study, one, out(tmp_path), runs=7)
    assert [attempt.verdict for attempt in report.attempts] == [
        "measured",
        "stopped",
        "better",
    ]
    # A run with the gains from before shows that the stage is sound.
    assert [run.reference for run in report.runs] == [
        *("small motion", "SIN2", "small motion", "small motion"),
        *("small motion", "SIN2"),
    ]
    assert one.gains() | GOOD == one.gains()


def test_a_stage_that_stays_broken_ends_with_the_safe_gains(study, tmp_path, scripted):
    scripted((GOOD, 0.01))

    def broken():
        one.faults = [Fault("stuck", 300, 900)]
        failing_at(one, 1, lambda: setattr(one, "faults", [Fault("stuck", 300, 900)]))

    one = failing_at(stage(), 4, broken)
    report = retune(study, one, out(tmp_path))
    assert report.verdict == "stopped"
    assert report.attempts[1].verdict == "stopped"
    assert "small motion after a stopped run" in report.alarms[0]
    assert "the safe gains of the stage are set" in report.alarms[0]
    assert one.gains() | SAFE == one.gains()
    assert one.voltage == pytest.approx(0.0, abs=1e-9)


def test_a_start_that_is_stopped_continues_with_the_safe_gains(
    study, tmp_path, scripted
):
    scripted((GOOD, 0.01))
    one = stage()
    one.apply(WILD)
    report = retune(study, one, out(tmp_path), runs=5)
    first, second, *_ = report.attempts
    assert first.verdict == "stopped"
    assert second.gains | SAFE == second.gains
    assert report.notes[0].startswith("the gains of the stage were stopped: small")
    assert report.ratio == np.inf
    assert one.gains() | GOOD == one.gains()


def test_safe_gains_that_are_too_slow_show_the_plant_by_small_shares(
    study, tmp_path, scripted
):
    scripted((GOOD, 0.05))
    one = stage(safe_gains=SLOW)
    one.apply(WILD)
    report = retune(study, one, out(tmp_path), runs=7)
    assert report.notes == [
        f"the {kind} of the stage were stopped: {where}: {why}"
        for kind, where, why in (
            ("gains", "small motion", report.runs[0].stopped),
            ("safe gains", "SIN2", "the tracking error is too large"),
        )
    ]
    shares = [(run.reference, run.share) for run in report.runs[1:5]]
    assert shares == [("small motion", 1.0), *(("SIN2", x) for x in (1.0, 0.1, 0.3))]
    assert not any(run.stopped for run in report.runs[3:])
    assert [attempt.verdict for attempt in report.attempts[2:3]] == ["better"]
    assert report.ratio == np.inf
    assert one.gains() | GOOD == one.gains()


def test_safe_gains_that_are_stopped_end_it(study, tmp_path):
    one = stage(safe_gains=WILD)
    report = retune(study, one, out(tmp_path))
    assert report.verdict == "stopped"
    assert report.best is None
    assert report.alarms[0].startswith("small motion with the safe gains: the ")
    assert len(report.runs) == 2


def test_without_gains_that_follow_the_stage_has_its_safe_gains(
    study, tmp_path, scripted
):
    scripted((GOOD, 0.01), (GOOD, 0.01))
    one = stage()
    whole = one.run

    def run(reference, gains):
        one.faults = [] if np.ptp(reference) < 1.0 else [Fault("stuck", 300, 900)]
        return whole(reference, gains)

    one.run = run
    report = retune(study, one, out(tmp_path), runs=20)
    assert [attempt.verdict for attempt in report.attempts] == ["stopped"] * 4
    assert report.verdict == "done"
    assert report.alarms == [
        "no gains followed the references; the safe gains of the stage are set"
    ]
    assert one.gains() | SAFE == one.gains()
    assert one.voltage == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("begin", "fitted"),
    [(600, [[1000, 600, 1000, 1000], [1000] * 3]), (300, [[1000] * 3])],
)
def test_a_run_is_fitted_until_its_first_missing_number(
    study, tmp_path, scripted, monkeypatch, begin, fitted
):
    scripted((GOOD, 0.05))
    seen = []
    monkeypatch.setattr(
        retuning,
        "_fit_again",
        lambda plant, records, small, file: (
            seen.append([r.samples for r in records]) or ["no"]
        ),
    )
    one = failing_at(
        stage(), 2, lambda: setattr(one, "faults", [Fault("dropout", begin, 400)])
    )
    report = retune(study, one, out(tmp_path), runs=8)
    # The second time without the run that was stopped.
    assert seen == fitted
    assert report.notes[-1].startswith("no plant describes run_01.npz, run_03.npz, ")


@pytest.mark.parametrize("run", [1, 2, 4])
@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (KeyboardInterrupt(), "stopped"),
        (LostError("the connection to the stage is lost"), "lost"),
        (RuntimeError("the driver failed"), "stopped"),
    ],
)
def test_every_failure_ends_with_an_alarm(
    study, tmp_path, scripted, run, error, verdict
):
    scripted((GOOD, 0.01))
    one = failing_at(stage(), run, raising(error))
    with pytest.raises(type(error)):
        retune(study, one, out(tmp_path))
    report = read(tmp_path / "out")
    assert report.verdict == verdict
    assert len(report.runs) == run - 1
    assert report.alarms
    if verdict == "stopped":
        assert one.gains() | SAFE == one.gains()


def test_an_interrupted_search_makes_the_stage_safe(study, tmp_path, scripted):
    scripted((None, 0.0))
    one = stage()
    with pytest.raises(KeyboardInterrupt):
        retune(study, one, out(tmp_path))
    assert one.gains() | SAFE == one.gains()
    assert read(tmp_path / "out").verdict == "stopped"


def test_it_goes_on_where_it_was(study, tmp_path, scripted):
    scripted((GOOD, 0.05), (None, 0.0))
    one = stage()
    before = one.gains()
    with pytest.raises(KeyboardInterrupt):
        retune(study, one, out(tmp_path), runs=8)
    assert one.gains() | SAFE == one.gains()
    known = read(tmp_path / "out")
    assert known.best == 1
    scripted((WORSE, 0.01), (WORSE, 0.01))
    report = retune(study, one, out(tmp_path), runs=8)
    assert report.before == before
    assert report.runs[:4] == known.runs
    assert report.attempts[:2] == known.attempts
    assert report.best == 1
    assert not report.alarms
    assert one.gains() | GOOD == one.gains()
    files = [run.file for run in report.runs]
    assert len(set(files)) == len(files)


def test_an_attempt_that_was_killed_counts_as_stopped(study, tmp_path, scripted):
    scripted((GOOD, 0.05))
    retune(study, stage(), out(tmp_path), runs=4)
    content = json.loads((tmp_path / "out" / RETUNE_FILE).read_text())
    content["attempts"][1] |= {"verdict": "running", "measured_um": None}
    content |= {"best": 0, "verdict": "running"}
    (tmp_path / "out" / RETUNE_FILE).write_text(json.dumps(content))
    report = retune(study, stage(), out(tmp_path), runs=4)
    assert report.attempts[1].verdict == "stopped"
    assert report.attempts[1].why == "the command was interrupted"
    assert report.verdict == "done"


def test_the_gains_from_before_are_saved_before_the_first_run(study, tmp_path):
    one = stage()
    one.apply({"integral": 650.0})

    def dying():
        saved = read(tmp_path / "out")
        assert saved.before["integral"] == 650.0
        assert saved.verdict == "running"
        raise SystemExit

    with pytest.raises(SystemExit):
        retune(study, failing_at(one, 1, dying), out(tmp_path))


def test_a_report_of_another_study_is_refused(study, tmp_path, scripted):
    scripted((GOOD, 5.0), (GOOD, 5.0))
    retune(study, stage(), out(tmp_path))
    write_study(tmp_path, seed=4)
    with pytest.raises(ValueError, match="is of another study: name a new folder"):
        retune(study, stage(), out(tmp_path))


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"rate": 2e3}, "rate"),
        ({"actuator": STUDY["actuator"] | {"bandwidth": 300.0}}, "an amplifier"),
        ({}, "tunes controller.proportional, but the stage has no gain proportional"),
    ],
)
def test_another_stage_is_refused(tmp_path, tables, message):
    path = write_study(tmp_path, **tables)
    one = stage()
    if "no gain" in message:
        one.gains = lambda: {"speed": 1.0}
    with pytest.raises(ValueError, match=message):
        retune(path, one, out(tmp_path))
    assert not (tmp_path / "out" / RETUNE_FILE).exists()


def test_a_stage_at_another_rate_is_refused(study, tmp_path):
    one = stage()
    one.dt = 2.0 * DT
    with pytest.raises(ValueError, match="the stage runs at 500 Hz and the study at 1"):
        retune(study, one, out(tmp_path))


def commanded(study, address, *more):
    folder = study.parent / "results"
    return call("retune", study, "--stage", address, "--out", folder, *more)


def test_the_command_writes_a_page_and_goes_on(study, scripted):
    scripted((GOOD, 0.05), (None, 0.0))
    one = stage()
    with served(one) as address:
        first = commanded(study, address, "--runs", "8")
        assert first.exit_code == 130
        assert one.gains() | SAFE == one.gains()
        scripted((WORSE, 0.01), (WORSE, 0.01))
        printed = succeeded(commanded(study, address, "--runs", "8")).stdout
    assert "524 nm to 107 nm rms, 4.9 times smaller" in printed
    assert "the stage has the gains of attempt 2" in printed
    assert re.search(r"integral +│ +500 │ 2500 │ V/\(um s\)", printed)
    assert one.gains() | GOOD == one.gains()
    folder = study.parent / "results"
    assert (folder / "retune.png").stat().st_size > 20_000
    page = (folder / "report.html").read_text()
    assert "Errors by attempt, and the first and the best run" in page
    assert "attempts: rms error with noise" in page


def test_a_run_without_a_measured_error_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(Bench, "run", lambda *_: TriedRun(reference="SIN1", share=1.0))
    report = RetuneReport(stage="one", title="", study_sha256="", before=GOOD)
    motion = Motion("SIN1", np.sin(np.arange(500.0)), 0.1)
    attempt = Attempt(gains=GOOD)
    Bench(stage(), [motion], tmp_path, report, 9, Silent()).measure(attempt)
    assert attempt.verdict == "stopped"
    assert attempt.why.endswith(": the run has no measured error (measured_um)")


@pytest.mark.parametrize(
    ("later", "shown"),
    [
        (0.02, {"first and best run": "10 nm"}),
        (None, {"first and best run": "10 nm"}),
        (0.005, {"first run": "10 nm", "best run": "5 nm"}),
    ],
)
def test_the_picture_names_the_best_run(tmp_path, later, shown):
    runs = []
    for i, error in enumerate((0.01, later)):
        save_samples(run_file(tmp_path, i), *np.ones((3, 9)))
        runs.append(
            TriedRun(
                reference="SIN1",
                share=1.0,
                measured_um=error,
                file=run_file(tmp_path, i).name,
            )
        )
    report = RetuneReport(
        stage="one",
        title="two runs",
        study_sha256="",
        before=GOOD,
        runs=runs,
        attempts=[Attempt(gains=GOOD, measured_um=0.01)],
        best=0,
    )
    (picture,) = write_retuning(report, tmp_path, DT).values()
    _, _, *panels = [panel.get_title().strip() for panel in picture.axes]
    assert dict(zip(panels[::2], panels[1::2], strict=True)) == {
        f"SIN1, {run}": f"Error: {error} rms" for run, error in shown.items()
    }


def test_the_command_ends_with_the_alarm(study):
    with served(stage(safe_gains=WILD)) as address:
        result = commanded(study, address)
    assert result.exit_code == 3
    assert "ALARM: small motion with the safe gains: the " in result.stdout
    assert "no gains followed the references; the stage has its safe gains" in (
        result.stdout
    )


def test_a_folder_in_use_is_refused(study, scripted):
    scripted((GOOD, 5.0), (GOOD, 5.0))
    one = stage()
    with served(one) as address:
        succeeded(commanded(study, address))
        with claimed(study.parent / "results"):
            result = commanded(study, address)
    assert result.exit_code == 1
    assert "is in use by a running command" in result.stderr


def test_the_default_of_the_command_is_that_of_the_function():
    default = inspect.signature(retune).parameters["runs"].default
    options = {option.name: option.default for option in main_of("retune").params}
    assert options["runs"] == default


RINGING = {"proportional": 30.0, "integral": 900.0}


def late_stage(**changed):
    """Return a stage that rings with RINGING, which its guard does not see."""
    wide = {"slew": 1e6, "largest_error": 50.0, "patience": 1000}
    late = lag() >> FractionalDelay(3.0 * DT, DT, 5)
    return stage(plant=late, limits=replace_limits(LIMITS, **wide), **changed)


def test_gains_that_ring_do_not_follow_the_references(study, tmp_path, scripted):
    """The guard does not see it: the error in the small motion is small."""
    scripted((RINGING, 0.01), (GOOD, 0.05))
    report = retune(study, late_stage(), out(tmp_path), runs=6)
    assert report.attempts[1].why == "small motion: the loop rings"
    assert report.runs[3].reference == "small motion"
    assert report.attempts[2].verdict == "better"


def test_a_start_that_rings_gives_way_to_the_safe_gains(study, tmp_path, scripted):
    scripted((GOOD, 5.0, "the loop is unstable"))
    one = late_stage()
    one.apply(RINGING)
    report = retune(study, one, out(tmp_path))
    first, second, *_ = report.attempts
    assert first.why == "small motion: the loop rings"
    assert second.gains | SAFE == second.gains
    assert one.gains() | SAFE == one.gains()


def test_safe_gains_that_ring_end_it(study, tmp_path):
    report = retune(study, late_stage(safe_gains=RINGING), out(tmp_path))
    assert report.verdict == "stopped"
    assert report.alarms[0].startswith(
        "small motion with the safe gains: the loop rings"
    )
