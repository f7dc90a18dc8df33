"""Sweeps from study to data set: the numbers, the labels, the files, the command."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from page_reader import checked
from swept_studies import GRID, study_of

import piezojax as pj
from piezojax.analysis.stability import OperatingPoint
from piezojax.cli.sweep import main
from piezojax.core.feedback import loop_inputs
from piezojax.core.paths import replace
from piezojax.report.sweep_maps import panels
from piezojax.study import Study, build
from piezojax.sweeping import run_sweep
from piezojax.sweeping.local import local_chunks
from piezojax.sweeping.simulator import Simulator
from piezojax.tuning.data import make_data
from piezojax.tuning.runs import Signals, evaluate

ALL = ["rms_error", "peak_error", "rms_effort", "rms_slew", "saturated", "peak_voltage"]
CHUNKED = GRID | {"chunk": 15}
SAMPLED = {
    "method": "sobol",
    "samples": 150,
    "metrics": ["rms_error", "saturated"],
    "chunk": 64,
}


def opened(folder):
    return xr.load_dataset(folder / "sweep.nc", engine="h5netcdf", decode_times=False)


def assert_same_bits(one, other):
    assert one.identical(other)
    for name in one.variables:
        a, b = one[name].values, other[name].values
        if a.dtype.kind == "f":
            assert a.tobytes() == b.tobytes()


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def failed(result, message):
    assert result.exit_code == 1, result.output
    assert result.stderr.count("\n") == 1
    assert message in result.stderr


def test_a_grid_equals_single_evaluations(case_of):
    case = case_of(GRID | {"metrics": ALL})
    found = pj.sweep(case)
    assert found is not None
    dims = ("controller.proportional", "plant.time_constant", "plant", "reference")
    assert found.rms_error.dims == dims
    assert found.reference.values.tolist() == ["SIN50", "SW50"]
    assert found.rms_error.attrs["units"] == "um"
    assert found.peak_voltage.attrs["units"] == "V"
    assert found["plant.time_constant"].attrs["units"] == "s"
    signals = make_data(case).holdout
    judge = jax.jit(lambda loop: evaluate(lambda x: x, loop, signals, start=100))
    for gain in found["controller.proportional"].values:
        for lag in found["plant.time_constant"].values:
            values = {"controller.proportional": gain, "plant.time_constant": lag}
            figures = judge(replace(case.loop, values))
            for name in ALL:
                np.testing.assert_allclose(
                    found[name].sel(values).isel(plant=0),
                    np.asarray(getattr(figures, name))[:, 0],
                    rtol=1e-12,
                    err_msg=f"{name} at {values}",
                )


def test_trajectories_have_every_nth_sample(case_of):
    every = 7
    case = case_of(CHUNKED | {"every": every}, holdout_draws=2)
    found = pj.sweep(case)
    assert found is not None
    assert found.displacement.dims[-3:] == ("reference", "draw", "time")
    np.testing.assert_allclose(found.time, np.arange(0, 400, every) / 20_000.0)
    place = {"controller.proportional": 2.0, "plant.time_constant": 5e-4}
    loop, signals = replace(case.loop, place), make_data(case).holdout
    reference, noise = signals.references[1], signals.noise[1, 1]
    inputs = loop_inputs(reference, noise)
    metric = pj.core.metrics.Tracking(start=100)

    @jax.jit
    def run(loop):
        start = loop.init(reference[0])
        return [
            pj.simulate(loop, inputs, start, **options)[1]
            for options in ({}, {"metric": metric})
        ]

    log, figures = run(loop)
    chosen = found.sel(place | {"reference": "SW50", "draw": 1}).isel(plant=0)
    for name in ("displacement", "voltage"):
        np.testing.assert_allclose(
            chosen[name], np.asarray(getattr(log, name))[::every], atol=1e-12
        )
    np.testing.assert_array_equal(chosen.followed, reference[::every])
    np.testing.assert_allclose(chosen.rms_error, figures.rms_error, rtol=1e-12)


def test_samples_carry_their_parameters(case_of):
    case = case_of(SAMPLED)
    found = pj.sweep(case)
    assert found is not None
    assert found.rms_error.dims == ("sample", "plant", "reference")
    wanted = Simulator(case).plan.values(0, 150)
    for column, path in enumerate(case.space.paths):
        assert found[path].dims == ("sample",)
        assert path in found.coords
        np.testing.assert_array_equal(found[path], wanted[:, column])
    last = dict(zip(case.space.paths, wanted[-1], strict=True))
    signals = make_data(case).holdout
    judge = jax.jit(lambda loop: evaluate(lambda x: x, loop, signals, start=100))
    figures = judge(replace(case.loop, last))
    np.testing.assert_allclose(
        found.rms_error[-1, 0], figures.rms_error[:, 0], rtol=1e-12
    )


@pytest.mark.slow
def test_sensitivity_equals_that_of_the_stability_report(case_of):
    table = {
        "metrics": ["sensitivity_peak"],
        "plants": ["p753", "p753_chapter4"],
        "parameters": {
            "controller.cutoff": {"values": [300.0, 3000.0]},
            "controller.feedback.law.integral": {"values": [5.0, 1000.0]},
        },
    }
    case = case_of(
        table,
        plant={"catalog": "p753"},
        controller={"catalog": "p753_disturbance_observer"},
        parameters={"controller.cutoff": {"lower": 100.0, "upper": 2e4}},
    )
    found = pj.sweep(case)
    assert found is not None
    assert found.sensitivity_peak.dims[-1] == "plant"
    highest = float(make_data(case).holdout.references.max())
    for name, plant in case.plants.items():
        for cutoff in (300.0, 3000.0):
            values = {
                "controller.cutoff": cutoff,
                "controller.feedback.law.integral": 5.0,
            }
            loop = replace(case.loop, values)
            loop = pj.Feedback(loop.controller, plant, loop.actuator, loop.sensor)
            reports = [
                pj.stability_report(loop, OperatingPoint(highest, branch))
                for branch in ("ascending", "descending")
            ]
            peaks = [r.sensitivity_peak if r.stable else np.inf for r in reports]
            peak = float(found.sensitivity_peak.sel(values).sel(plant=name))
            assert peak == pytest.approx(max(peaks), rel=2e-3)
    at_five = found.sensitivity_peak.sel({"controller.feedback.law.integral": 5.0})
    assert np.isfinite(at_five).sum() == 3  # one loop is unstable
    lost = found.sensitivity_peak.sel({"controller.feedback.law.integral": 1000.0})
    assert np.isinf(lost).all()


AXES = {
    "rate": 500.0,
    "axes": {"names": ["Z", "Rx", "Ry"], "units": ["um", "urad", "urad"]},
    "plant": {"catalog": "p558"},
    "actuator": {"lower": [-60.0, -300.0, -300.0], "upper": [60.0, 300.0, 300.0]},
    "sensor": {"noise_rms": [0.0008, 0.013, 0.013]},
    "controller": {"catalog": "p558_pid"},
    "references": {"tune": ["Z:SIN5 Rx:SIN10"], "duration": 0.4, "settle": 0.2},
    "parameters": {"controller.Z.integral": {"lower": 10.0, "upper": 500.0}},
}


@pytest.mark.slow
def test_several_axes_have_a_dimension(case_of, tmp_path):
    table = {"every": 10, "parameters": {"controller.Z.integral": {"values": [100.0]}}}
    case = case_of(table, **AXES)
    found = pj.sweep(case, out=tmp_path / "axes")
    assert found is not None
    assert found.rms_error.dims[-2:] == ("reference", "axis")
    assert found.displacement.dims[-2:] == ("axis", "time")
    assert found.axis_unit.values.tolist() == ["um", "urad", "urad"]
    data = make_data(case).holdout
    signals = Signals(data.references, data.noise)
    judge = jax.jit(lambda loop: evaluate(lambda x: x, loop, signals, 100))
    figures = judge(replace(case.loop, {"controller.Z.integral": 100.0}))
    np.testing.assert_allclose(found.rms_error[0, 0], figures.rms_error[:, 0], 1e-12)
    np.testing.assert_array_equal(
        found.followed[0], np.asarray(data.references)[0, ::10].T
    )
    # A picture has a panel for each axis in its unit.
    assert [panel.unit for panel in panels(found, "rms_error")] == ["nm", *["nrad"] * 2]
    with pytest.raises(ValueError, match="needs a stage with one axis"):
        Simulator(case_of(table | {"metrics": ["sensitivity_peak"]}, **AXES))


def test_merged_shards_equal_the_whole_sweep_bit_for_bit(case_of, tmp_path):
    case = case_of(SAMPLED | {"chunk": 1})  # rounded up to a block of 64
    run_sweep(case, tmp_path / "whole")
    done = [
        run_sweep(case, tmp_path / "shards", shard=(i, 4)).finished
        for i in (3, 1, 4, 2)
    ]
    assert done == [False, False, False, True]
    whole = opened(tmp_path / "whole")
    assert_same_bits(whole, opened(tmp_path / "shards"))
    again = run_sweep(case, tmp_path / "shards", shard=(2, 4))
    assert (again.finished, again.simulated) == (True, 0)
    assert pj.sweep(case, out=tmp_path / "other", shard=(2, 2)) is None


def test_damaged_and_missing_chunks_are_simulated_again(case_of, tmp_path):
    case = case_of(SAMPLED)
    run_sweep(case, tmp_path / "a")
    whole = opened(tmp_path / "a")
    chunks = sorted((tmp_path / "a" / "chunks").iterdir())
    assert len(chunks) == 3
    content = bytearray(chunks[0].read_bytes())
    content[-5] ^= 1
    chunks[0].write_bytes(content)
    chunks[1].write_bytes(chunks[1].read_bytes()[:-8])
    (tmp_path / "a" / "sweep.nc").unlink()
    again = run_sweep(case, tmp_path / "a")
    assert (again.simulated, again.finished) == (2, True)
    assert_same_bits(whole, opened(tmp_path / "a"))
    # In the share of another process the damage is found by the merge.
    content[0] ^= 1
    chunks[2].write_bytes(content)
    (tmp_path / "a" / "sweep.nc").unlink()
    again = run_sweep(case, tmp_path / "a", shard=(1, 3))
    assert (again.simulated, again.finished) == (1, True)
    assert_same_bits(whole, opened(tmp_path / "a"))


def test_a_study_that_is_only_swept_has_nothing_to_tune():
    study = {name: x for name, x in study_of(GRID).items() if name != "parameters"}
    case = build(Study.model_validate(study), "study.toml")
    found = pj.sweep(case)
    assert found is not None
    assert found.sizes["controller.proportional"] == 5
    with pytest.raises(ValueError, match="tune and parameters are missing; name at"):
        pj.tune(case)
    drawn = study | {"sweep": {"method": "sobol", "samples": 8}}
    with pytest.raises(ValueError, match="tune and parameters are missing; name at"):
        Study.model_validate(drawn)


def test_a_partially_written_chunk_is_ignored(case_of, tmp_path):
    case = case_of(SAMPLED)
    (tmp_path / "a" / "chunks").mkdir(parents=True)
    (tmp_path / "a" / "chunks" / ".00000000.chunk.x").write_bytes(b"half")
    (tmp_path / "a" / ".manifest.json.x").write_bytes(b"half")
    assert run_sweep(case, tmp_path / "a").simulated == 3


def test_an_interrupted_sweep_continues(case_of, tmp_path):
    case = case_of(SAMPLED)
    run_sweep(case, tmp_path / "whole")

    class Interrupting:
        def stage(self, text, steps=0):
            pass

        def advance(self, best, note=""):
            assert note.endswith("left")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(case, tmp_path / "a", progress=Interrupting())
    assert len(list((tmp_path / "a" / "chunks").iterdir())) == 1
    assert run_sweep(case, tmp_path / "a").simulated == 2
    assert_same_bits(opened(tmp_path / "whole"), opened(tmp_path / "a"))


def test_foreign_folders_and_chunks_are_refused(case_of, write, tmp_path):
    case = case_of(SAMPLED)
    run_sweep(case, tmp_path / "a")
    other = case_of(SAMPLED | {"samples": 151})
    with pytest.raises(
        ValueError, match=r"holds another sweep \(it differs in study\.sweep"
    ):
        run_sweep(other, tmp_path / "a")
    with pytest.raises(ValueError, match=r"\(it differs in files\); name a new"):
        run_sweep(dataclasses.replace(case, contents=("new content",)), tmp_path / "a")
    run_sweep(other, tmp_path / "b")
    name = "00000001.chunk"
    shutil.copy(tmp_path / "a" / "chunks" / name, tmp_path / "b" / "chunks" / name)
    (tmp_path / "b" / "sweep.nc").unlink()
    with pytest.raises(ValueError, match="belongs to another sweep"):
        run_sweep(other, tmp_path / "b")
    manifest = tmp_path / "a" / "manifest.json"
    stale = json.loads(manifest.read_text())
    stale["versions"]["piezojax"] = stale["fingerprint"] = "0"
    manifest.write_text(json.dumps(stale))
    with pytest.raises(ValueError, match="differs in versions"):
        run_sweep(case, tmp_path / "a")
    manifest.write_text("{")
    with pytest.raises(ValueError, match=r"manifest\.json is damaged"):
        run_sweep(case, tmp_path / "a")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "result.json").touch()
    with pytest.raises(ValueError, match="holds results that are not of a sweep"):
        run_sweep(case, tmp_path / "c")


def test_all_chunks_use_one_compiled_program(case_of):
    simulator = Simulator(case_of(SAMPLED))
    device = jax.devices()[0]
    simulator.compile(device)
    programs = dict(simulator._programs)
    with local_chunks(simulator, range(3), [device, device]) as chunks:
        assert sorted(chunk for chunk, _, _ in chunks) == [0, 1, 2]
    assert simulator._programs == programs


@pytest.mark.parametrize("table", [GRID, SAMPLED])
def test_command_writes_data_set_and_pictures(write, tmp_path, table):
    result = call(write(table), "--out", tmp_path / "a")
    assert result.exit_code == 0, result.output
    assert "geometric mean over 2 references" in " ".join(result.stdout.split())
    for name in table["metrics"]:
        content = (tmp_path / "a" / f"{name}.png").read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) > 10_000
    title = str(opened(tmp_path / "a").attrs["title"])
    assert checked(tmp_path / "a" / "report.html").headings[0] == title
    assert opened(tmp_path / "a").attrs["study"] == "study"


def test_command_by_shards(write, tmp_path):
    path = write(SAMPLED)
    first = call(path, "--out", tmp_path / "a", "--shard", "2/2")
    assert first.exit_code == 0
    assert "shard 2/2 is complete, 1 chunks" in first.stdout
    assert not (tmp_path / "a" / "sweep.nc").exists()
    second = call(path, "--out", tmp_path / "a", "--shard", "1/2", "--quiet")
    assert (second.exit_code, second.output) == (0, "")
    assert (tmp_path / "a" / "rms_error.png").exists()


def test_command_refuses_in_one_line(write, tmp_path):
    path = write(GRID)
    failed(call(path, "--shard", "1/2"), "--shard needs --out")
    failed(call(path, "--shard", "3/2"), "it must be i/n, from 1/n to n/n")
    failed(call(path, "--samples", "4"), "the study sweeps a grid")
    failed(call(tmp_path / "no.toml"), "No such file")
    failed(call(write(None)), "no table [sweep]")
    failed(call(path, "--dask", "0", "--out", tmp_path / "d"), "at least 1 worker")
    with pytest.raises(ValueError, match="a shard needs a folder"):
        pj.sweep(path, shard=(1, 2))
