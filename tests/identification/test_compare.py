"""Comparison of models: fits, failures, and the written files."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

import piezojax as pj
from piezojax import (
    Record,
    load,
)
from piezojax.cli.identify import main
from piezojax.core.system import Affine
from piezojax.dynamics import FirstOrderLag
from piezojax.identification import (
    free_run,
    identify_all,
    model_search,
)
from piezojax.identification.across import errors_across
from piezojax.identification.candidates import parts_at
from piezojax.identification.estimators.estimate import Options
from piezojax.identification.fit import Fit, FitError, FitReport
from piezojax.identification.ranking import RankingReport
from piezojax.identification.records.parts import longest_first
from piezojax.report.model_ranking import (
    ranking_notes,
    ranking_table,
    write_ranking,
    write_ranking_so_far,
)

HYSTERESIS = parts_at("hysteresis")
TIME = np.arange(2000) * 1e-3
TONES = sum(np.sin(2 * np.pi * f * TIME + f) for f in (2.0, 9.0, 31.0, 77.0))
RICH = Record(TONES, 0.1 * TONES + 1.0, 1e-3, source="made up")
SHORT = RICH.until(1700)


def test_an_unknown_hysteresis_is_refused():
    with pytest.raises(ValueError, match="'lag' is not a hysteresis model; there"):
        identify_all(RICH, hysteresis=["lag"])


# The search, with synthetic fits

NOISE = np.random.default_rng(0).standard_normal((2000, 1))
BIAS = {"coleman_hodgdon": 1e-4}
"""Errors of the simulations in addition to the noise; other models have larger ones."""


def made_up(records, model, *, train, validate, progress, method, options):
    """Return a fit whose errors are the noise plus a part of the model."""
    progress.stage("fitting", 1)
    head = model.split("+")[0]
    records = longest_first(records)
    own = BIAS.get(head, 0.5) * np.sin(np.arange(2000))[:, None]
    off = 0.01 * (NOISE + own)
    runs = tuple(record.outputs + off[: record.samples] for record in records)
    blank = FitError(rmse=0.0, rmse_percent_of_span=0.0, unit="um")
    report = FitReport(
        model=model, parameters={}, train=blank, validation=blank, warnings=[], wall_s=0
    )
    fit = Fit(Affine(2.0), report, records, runs, train, validate, None, 5)
    fit.report.train = fit.error_over(train)
    fit.report.validation = fit.error_over(validate)
    return fit


@pytest.fixture
def made(monkeypatch):
    """Replace the fits by ``made_up``; chosen models fail."""

    def install(wrong=()):
        def fit(records, model, **more):
            for part, error in dict(wrong).items():
                if part in model:
                    raise error
            return made_up(records, model, **more)

        monkeypatch.setattr(model_search, "identify", fit)

    return install


def test_the_first_of_two_equivalent_models_is_chosen(made, monkeypatch):
    made()
    monkeypatch.setitem(BIAS, "prandtl_ishlinskii", 1e-4)
    monkeypatch.setitem(BIAS, "stop_prandtl_ishlinskii", 2e-4)
    monkeypatch.delitem(BIAS, "coleman_hodgdon")
    found = identify_all(RICH)
    rows = {row.model: row for row in found.report.rows}
    stop = rows["stop_prandtl_ishlinskii+exponential_creep+arma"]
    plays = "prandtl_ishlinskii+exponential_creep+arma"
    assert stop.bic < rows[plays].bic
    assert found.report.best.split("+")[0] == "prandtl_ishlinskii"
    assert stop.note == f"equivalent to {plays}"
    assert f"{stop.model} is {stop.note}" in ranking_notes(found.report)
    # Another model replaces it in further rounds.
    assert not any(
        "stop_" in model and "exponential" not in model for model in found.fits
    )


def test_the_best_model_is_chosen_and_the_others_are_kept(made):
    made()
    found = identify_all(RICH)
    report = found.report
    assert report.best.split("+")[0] == "coleman_hodgdon"
    assert found.best is found.fits[report.best]
    fitted = [row for row in report.rows if row.status == "fitted"]
    assert fitted[0].model == report.best
    assert fitted[0].validates_as_well
    assert len(fitted) == len(found.fits)
    assert {row.model.split("+")[0] for row in fitted} >= set(HYSTERESIS)
    assert report.samples == 1000
    assert 500 < report.effective_samples[0] <= 1000
    assert not report.interrupted


def test_a_failed_model_is_a_row_with_its_error(made):
    made({"prandtl_ishlinskii+": ValueError("no start"), "shaped": RuntimeError("xla")})
    rows = {row.model: row for row in identify_all(RICH).report.rows}
    failed = [row for row in rows.values() if row.status == "failed"]
    assert {row.note for row in failed} >= {"no start", "RuntimeError: xla"}
    assert any(row.status == "fitted" for row in rows.values())


def test_a_fit_with_non_finite_values_has_failed(made, monkeypatch):
    made()

    def fit(records, model, **more):
        found = made_up(records, model, **more)
        if "shaped" in model:
            found.report.validation.rmse = np.inf
        return found

    monkeypatch.setattr(model_search, "identify", fit)
    rows = identify_all(RICH).report.rows
    (row,) = (row for row in rows if row.model.startswith("shaped"))
    assert (row.status, row.note) == ("failed", "its free run is not finite")


def test_no_fitted_model_is_an_error(made):
    made({"": ValueError("nothing helps")})
    with pytest.raises(ValueError, match=r"no model could be fitted .*nothing helps"):
        identify_all(RICH)


def test_ctrl_c_keeps_the_fitted_models(made):
    made({"prandtl_ishlinskii": KeyboardInterrupt()})
    report = identify_all(RICH).report
    assert report.interrupted
    assert report.best.startswith("coleman_hodgdon")
    left = [row.model for row in report.rows if row.note == "interrupted before"]
    assert any(model.startswith("prandtl_ishlinskii") for model in left)
    assert "interrupted" in " ".join(ranking_notes(report))


def test_a_killed_search_leaves_a_ranking_of_the_finished_fits(made, tmp_path):
    made()
    seen = []

    def done(ranking):
        write_ranking_so_far(ranking, tmp_path)
        text = (tmp_path / "comparison.json").read_text()
        seen.append(RankingReport.model_validate_json(text))

    found = identify_all(RICH, done=done)
    assert len(seen) == len(found.fits)
    for count, report in enumerate(seen, start=1):
        assert report.interrupted
        fitted = [row for row in report.rows if row.status == "fitted"]
        assert len(fitted) == count
        for row in fitted:
            assert load(tmp_path / row.folder / "model.json")
    assert any(row.note == "interrupted before" for row in seen[0].rows)
    assert [row.model for row in seen[-1].rows if row.status == "fitted"] == list(
        found.fits
    )
    write_ranking(found, tmp_path)
    best = next(row for row in found.report.rows if row.model == found.report.best)
    assert best.folder == "."
    assert (tmp_path / "model.json").exists()
    places = {row.folder for row in found.report.rows if row.folder not in (None, ".")}
    assert {f"models/{p.name}" for p in (tmp_path / "models").iterdir()} == places


def counted(monkeypatch, stop=None):
    """Return the list of the models that are fitted; ``stop`` interrupts its fit."""
    models, fit = [], model_search.identify

    def one(records, model, **more):
        if stop is not None and model.startswith(stop):
            raise KeyboardInterrupt
        models.append(model)
        return fit(records, model, **more)

    monkeypatch.setattr(model_search, "identify", one)
    return models


@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("records", [[RICH], [RICH, RICH], [SHORT, RICH]])
def test_an_interrupted_search_goes_on(records, made, monkeypatch, tmp_path):
    made({"bouc_wen": ValueError("fails")})
    whole = identify_all(records)
    with monkeypatch.context() as patch:
        before = counted(patch, "prandtl_ishlinskii")
        assert identify_all(records, folder=tmp_path).report.interrupted
    after = counted(monkeypatch)
    (next((tmp_path / "search").glob("*.npz"))).write_bytes(b"damaged")
    found = identify_all(records, folder=tmp_path)
    assert not (tmp_path / "search").exists()
    # A failed fit and the damaged one are repeated.
    fits = [model for model in before if "bouc_wen" not in model]
    assert len(set(fits) & set(after)) == 1
    assert not found.report.interrupted

    def figures(ranking):
        return [row.model_copy(update={"wall_s": 0.0}) for row in ranking.report.rows]

    assert figures(found) == figures(whole)


def test_a_search_goes_on_only_with_the_same_records(made, monkeypatch, tmp_path):
    made({"prandtl_ishlinskii": KeyboardInterrupt()})
    identify_all(RICH, folder=tmp_path)
    other = Record(TONES, 0.1 * TONES + 1.1, 1e-3)
    for changes in (
        {"records": other},
        {"records": replace(RICH, period=len(TONES) // 8)},
        {"records": replace(RICH, reference=RICH.output)},
        {"train": slice(0, 900)},
        {"options": Options(steps=7)},
    ):
        with pytest.raises(ValueError, match="other records, parts, options or ver"):
            identify_all(**({"records": RICH, "folder": tmp_path} | changes))


def test_ctrl_c_before_anything_is_fitted(made):
    made({"": KeyboardInterrupt()})
    with pytest.raises(KeyboardInterrupt):
        identify_all(RICH)


def test_progress_counts_the_models(made):
    class Told:
        def __init__(self):
            self.stages = []

        def stage(self, text, steps=0):
            self.stages.append(text)

        def advance(self, best, note=""):
            pass

    made()
    told = Told()
    fits = identify_all(RICH, progress=told).fits
    assert len(told.stages) == len(fits)
    assert told.stages[0].startswith("1 of about ")
    assert told.stages[0].endswith(", exponential_creep+arma: fitting")
    assert told.stages[-1].startswith(f"{len(fits)} of about ")


# A test part that the choice does not use


def test_fits_and_choice_do_not_use_the_test_part(made):
    made()
    report = identify_all(RICH, test=slice(1600, None)).report
    assert (report.train, report.validation) == ((0, 800), (800, 1600))
    assert report.test_part == (1600, 2000)
    off = 0.01 * (NOISE[:, 0] + 1e-4 * np.sin(np.arange(2000)))[1600:]
    assert report.test.rmse == pytest.approx(np.sqrt(np.mean(off**2)))
    notes = " ".join(ranking_notes(report))
    assert "neither the fits nor the choice used" in notes
    assert "held-out" not in notes


def test_without_a_test_part_a_note_says_that_there_is_no_held_out_error(made):
    made()
    notes = " ".join(ranking_notes(identify_all(RICH).report))
    assert "--test START:STOP reserves samples" in notes


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"test": slice(5, 5)}, "test is 5:5; it must lie in 0:2000 and hold a"),
        ({"test": slice(5, 2001)}, "test is 5:2001; it must lie in 0:2000"),
        (
            {"test": slice(900, 950), "validate": slice(600, 1000)},
            "test 900:950 shares samples with validate 600:1000",
        ),
        ({"test": slice(0, 900)}, "train is 0:0; it must lie in 0:2000"),
    ],
)
def test_bad_test_parts(parts, message):
    with pytest.raises(ValueError, match=message):
        identify_all(RICH, **parts)


# Several records


def test_of_several_records_each_is_left_out_in_turn(made, monkeypatch):
    made()
    asked = []

    def left_out(records, fit_to):
        fit = fit_to(records[1:], slice(0, 2000))
        model = fit.report.model.split("+")[0]
        asked.append((model, len(records), fit.train, fit.validate))
        if model == "prandtl_ishlinskii":
            return None
        size = {"shaped_coleman_hodgdon": 0.5}.get(model, 1.0)
        return tuple(size * NOISE + own for own in (0.0, 0.1))

    monkeypatch.setattr(model_search, "errors_across", left_out)
    seen = []
    names = ["coleman_hodgdon", "shaped_coleman_hodgdon", "prandtl_ishlinskii"]
    ranking = identify_all(
        [RICH, RICH], hysteresis=names, done=lambda one: seen.append(one.report)
    )
    report = ranking.report
    # The validation part prefers coleman_hodgdon.
    assert report.best.split("+")[0] == "shaped_coleman_hodgdon"
    assert "left out of the fit" in report.rule
    assert all(one[1:] == (2, slice(0, 2000), slice(0, 2000)) for one in asked)
    rows = {row.model.split("+")[0]: row for row in report.rows if row.bic}
    assert rows["shaped_coleman_hodgdon"].across_rmse == pytest.approx(0.5, rel=0.1)
    fails = rows["prandtl_ishlinskii"]
    assert (fails.across_rmse, fails.validates_as_well) == (None, False)
    assert "it fails there" in " ".join(ranking_notes(report))
    assert ranking_table(report).row_count == len(ranking.fits)
    # A fit is kept before it has been judged on other records.
    assert [row.model for row in seen[0].rows if row.bic] == [asked_first(seen[0])]
    assert not seen[0].across
    assert seen[1].across


def asked_first(report):
    """Return the model of the only fit of a report."""
    (model,) = (row.model for row in report.rows if row.status == "fitted")
    return model


def test_the_choice_across_records_does_not_see_the_test(made, monkeypatch):
    made()
    lengths = set()

    def left_out(records, fit_to):
        lengths.update(record.samples for record in records)
        return (NOISE, NOISE)

    monkeypatch.setattr(model_search, "errors_across", left_out)
    identify_all([RICH, RICH], hysteresis=["coleman_hodgdon"], test=slice(1600, None))
    assert lengths == {1600}


def test_a_stop_while_a_fit_is_judged_keeps_the_fit(made, monkeypatch):
    made()

    def stopped(records, fit_to):
        raise KeyboardInterrupt

    monkeypatch.setattr(model_search, "errors_across", stopped)
    found = identify_all([RICH, RICH], hysteresis=["coleman_hodgdon"])
    assert found.report.interrupted
    assert [row.model for row in found.report.rows if row.bic] == list(found.fits)
    assert len(found.fits) == 1


def lag_of(gain):
    """Return a fit of a first-order lag with this gain."""
    system = pj.series(gain=Affine(gain), lag=FirstOrderLag(5e-3, 1e-3))
    blank = FitError(rmse=0.0, rmse_percent_of_span=0.0, unit="um")
    report = FitReport(
        model="lag", parameters={}, train=blank, validation=blank, warnings=[], wall_s=0
    )
    return Fit(system, report, (RICH,), (RICH.outputs,), slice(0, 9), slice(0, 9))


def test_errors_across_are_those_on_the_record_left_out():
    run = np.asarray(free_run(lag_of(0.1).system, jnp.asarray(TONES), TONES[0]))
    records = [Record(TONES, gain * run + 3.0, 1e-3) for gain in (1.0, 1.5)]
    asked = []

    def fit_to(others, part):
        asked.append((others, part))
        return lag_of(0.15 if others[0] is records[1] else 0.1)

    found = errors_across(records, fit_to)
    assert asked == [((records[1],), slice(0, 2000)), ((records[0],), slice(0, 2000))]
    for error, sign in zip(found, (1.0, -1.0), strict=True):
        assert error.shape[0] <= 1600
        part = run[-len(error) :]
        expected = sign * 0.5 * (part - part.mean())
        np.testing.assert_allclose(error[:, 0] - error.mean(), expected, atol=2e-3)

    def failing(others, part):
        raise RuntimeError("xla")

    assert errors_across(records, failing) is None


# Written files


def test_the_files_of_a_comparison(made, tmp_path):
    made({"shaped": ValueError("no start")})
    found = identify_all(RICH)
    write_ranking(found, tmp_path)
    for name in ("comparison.png", "fit.png"):
        assert (tmp_path / name).stat().st_size > 5000
    report = json.loads((tmp_path / "comparison.json").read_text())
    assert report["best"] == found.report.best
    assert json.loads((tmp_path / "fit.json").read_text())["model"] == report["best"]
    lines = (tmp_path / "comparison.csv").read_text().splitlines()
    assert len(lines) == len(report["rows"]) + 1
    for row in report["rows"]:
        if row["status"] == "fitted":
            assert "+" not in row["folder"]
            assert load(tmp_path / row["folder"] / "model.json") == Affine(2.0)
            fit = json.loads((tmp_path / row["folder"] / "fit.json").read_text())
            assert fit["model"] == row["model"]
        else:
            assert row["note"]
    assert ranking_table(found.report).row_count == len(found.fits) + 1


# The command


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture
def file(tmp_path):
    time = np.arange(300) * 1e-3
    level = np.where(time < 0.2, 20.0, 10.0)
    drive = level * (1.0 - np.cos(2 * np.pi * 20.0 * time))
    path = tmp_path / "bench.csv"
    rows = zip(time, drive, 0.12 * np.roll(drive, 1) + 4.0, strict=True)
    text = "\n".join(f"{t:.4f},{u:.6f},{y:.6f}" for t, u, y in rows)
    path.write_text("time_s,drive_V,sensor_um\n" + text + "\n")
    return path


def test_the_command_writes_and_prints_a_comparison(made, file, tmp_path):
    made()
    out = tmp_path / "out"
    arguments = ("--time", "time_s", "--input", "1", "--output", "2", "--model", "all")
    among = ("--among", "coleman_hodgdon,prandtl_ishlinskii", "--test", "250:300")
    result = call(file, *among, *arguments, "--out", out)
    assert result.exit_code == 0, result.output
    report = json.loads((out / "comparison.json").read_text())
    assert report["best"] == "coleman_hodgdon+lag"
    fitted = [row["model"] for row in report["rows"] if row["status"] == "fitted"]
    assert sorted(fitted) == ["coleman_hodgdon+lag", "lag", "prandtl_ishlinskii+lag"]
    assert report["test_part"] == [250, 300]
    for text in ("best: coleman_hodgdon+lag", "not tried: exponential_creep"):
        assert text in result.output
    assert (out / "models" / "prandtl_ishlinskii-lag" / "model.json").is_file()
    again = call(file, *arguments, "--out", out)
    assert again.exit_code == 1
    assert "already holds results" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--model", "all", "--method", "subspace"), "--method needs one model"),
        (("--test", "0:5"), "--among and --test need --model all"),
        (("--among", "coleman_hodgdon"), "--among and --test need --model all"),
        (("--among", ""), "--among and --test need --model all"),
        (("--order", "3"), "--order: not used in the fit of auto; leave it out"),
        (
            ("--model", "state_space", "--steps", "9", "--order", "3"),
            "--steps: not used in the fit of state_space",
        ),
        (
            ("--response", "--window", "9", "--oversample", "2"),
            "--window, --oversample: not used with --response or --controller",
        ),
    ],
)
def test_inconsistent_options_are_refused(file, arguments, message):
    result = call(file, *arguments)
    assert result.exit_code == 1
    assert message in result.stderr
