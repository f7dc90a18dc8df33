"""Exported controllers in the simulated loop: costs of float and compensated sums."""

import dataclasses
import io
import subprocess
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exported_folders import compiled
from rich.console import Console

import piezojax as pj
from piezojax import study as studies
from piezojax.catalog import CONTROLLERS
from piezojax.cli.export import export_file
from piezojax.core.files import read_model
from piezojax.core.parameter import parameter
from piezojax.core.system import Affine
from piezojax.exporting import Driven, Seen
from piezojax.exporting.c_project import CProject
from piezojax.exporting.compiled_loop import CompiledLoop, Runs, RunTrace
from piezojax.exporting.judge import ExportReport, judge
from piezojax.exporting.slots import Interface
from piezojax.report.export_tables import judgement
from piezojax.tuning.data import make_data
from piezojax.tuning.exported_runs import holdout_of, make_runs
from piezojax.tuning.runs import evaluate

pytestmark = compiled

SAMPLES, STEP, SLOW = 40_000, 2e-3, 5e-4
"""Number of samples, step of the reference (um), and gain of the integral (V/um)."""

LIMITS = (-200.0, 200.0)


class Integral(pj.System):
    """An integral in V that ``count`` increments by a gain times the error."""

    gain: jax.Array = parameter("V/um", "gain of a sample", default=SLOW)
    count: Callable = eqx.field(static=True, default=lambda x, more: x + more)

    def init(self, input):
        return input.applied

    def step(self, state, input):
        more = self.gain * (input.reference - input.measured)
        return self.count(state, more), state


def slow_runs():
    """Return a step of 2 nm at 5 um on a stage of 0.1 um/V without noise."""
    zero = jnp.asarray(0.0)
    rows = np.zeros((1, SAMPLES, 5))
    rows[:, :, :2] = 5.0 + STEP
    return Runs(
        Affine(0.1),
        pj.hardware.Sensor(0.0),
        Interface(zero, zero),
        Interface((zero, zero), (zero, zero)),
        np.array([[5.0, 5.0, 5.0, 50.0, 5.0]]),
        rows,
        (RunTrace("STEP", "um", slice(0, 1), 0),),
        0,
    )


def interface_of(value=5.0):
    """Return the signals of a controller of one axis at ``value`` um."""
    at = jnp.asarray(value)
    return Interface(pj.Observation(at, at, at, 10.0 * at), Seen(at, at, at))


def displacements(system, precision):
    """Return the displacements (um) of the compiled ``system`` in the slow runs."""
    code = CProject(system, interface_of(), "controller", pj.About(), precision)
    return CompiledLoop(slow_runs()).steps(code).displacements.ravel()


def by_hand(kind, counted):
    """Return the displacements (um) of a loop of NumPy in the precision ``kind``."""
    integral, rest, y, found = kind(50.0), kind(0.0), 5.0, []
    gain, reference = kind(SLOW), kind(5.0 + STEP)
    for _ in range(SAMPLES):
        found.append(y)
        y = 0.1 * float(integral)
        more = gain * (reference - kind(found[-1]))
        integral, rest = counted(integral, more, rest)
    return np.array(found)


def kahan(total, more, rest):
    """Return a sum and what it lost, by the algorithm of Kahan."""
    more = more + rest
    new = total + more
    return new, more - (new - total)


def test_float_equals_a_loop_of_numpy_in_single_precision():
    system = Driven(Integral(), pj.Saturation(*LIMITS))
    plain = by_hand(np.float32, lambda total, more, rest: (total + more, rest))
    np.testing.assert_array_equal(displacements(system, "float"), plain)
    assert abs(plain[-1] - 5.0 - STEP) > 0.9 * STEP  # the integral stands still
    carried = by_hand(np.float32, kahan)
    np.testing.assert_allclose(
        displacements(system, "compensated"), carried, rtol=0.0, atol=1e-6
    )
    exact = by_hand(np.float64, lambda total, more, rest: (total + more, rest))
    np.testing.assert_allclose(
        displacements(system, "double"), exact, rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize(
    "count",
    [
        lambda x, more: x + more,
        lambda x, more: -(-more - x),
        lambda x, more: jnp.clip(x - (-more), *LIMITS),
        lambda x, more: jnp.where(more < 1.0, more + x, x),
        lambda x, more: jnp.minimum(jnp.maximum(x + more, LIMITS[0]), LIMITS[1]),
        lambda x, more: (x + 0.5 * more) + 0.5 * more,
    ],
)
def test_a_slow_integral_that_float_loses_is_written_compensated(count):
    system = Driven(Integral(count=count), pj.Saturation(*LIMITS))
    report = judge(system, interface_of(), slow_runs(), "float")
    costs = report.references["STEP"]
    assert costs.percent["float"] > 50.0
    assert abs(costs.percent["compensated"]) < 5.0
    assert report.written == "compensated"
    (why,) = report.costly("float")
    assert report.why == why
    assert why.startswith("float costs ")
    assert " nm under STEP, " in why
    assert report.warnings == []
    forms = report.forms
    assert forms["double"].state_bytes > forms["compensated"].state_bytes
    assert forms["compensated"].state_bytes == forms["float"].state_bytes + 4
    assert forms["compensated"].operations > forms["float"].operations
    assert 0.0 < forms["float"].ns < 1e4


def test_a_filter_that_no_sum_rescues_is_warned_about():
    """``0.99999 x + ...`` rounds its product, whose error no sum carries."""
    system = Driven(
        Integral(count=lambda x, more: x * (1.0 - 1e-9) + more),
        pj.Saturation(*LIMITS),
    )
    report = judge(system, interface_of(), slow_runs(), "float")
    (warning,) = report.warnings
    assert warning.startswith("compensated costs")
    assert warning.endswith("% of the error: use double")


def test_an_export_writes_the_form_that_it_reports(tmp_path):
    files = pj.export(
        Integral(),
        tmp_path / "c",
        about=pj.About(judged=["not here"], reference_ranges=[(0.0, 10.0)]),
        limits=[LIMITS],
        precision="float",
        runs=slow_runs(),
    )
    report = read_model(ExportReport, files[-1], "is no report")
    assert files[-1].name == "report.json"
    assert report.written == "compensated"
    assert "float rounding;" in files[0].read_text()
    made = ["make", "-s", "test"]
    assert subprocess.run(made, cwd=tmp_path / "c").returncode == 0


def test_without_a_compiler_the_report_says_so(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    system = Driven(Integral(), pj.Saturation(*LIMITS))
    report = judge(system, interface_of(), slow_runs(), "float")
    assert report.written == "float"
    assert report.not_judged == "there is no C compiler (cc)"
    assert report.references == {}


def test_a_loop_that_diverges_is_not_judged():
    system = Driven(Integral(count=lambda x, more: jnp.nan * x), pj.Saturation(*LIMITS))
    report = judge(system, interface_of(), slow_runs(), "float")
    assert report.not_judged == "the loop diverges"
    (alarm,) = report.alarms
    assert alarm.startswith("the compiled controller diverges in the simulated loop")
    assert judgement(report)[0].startswith("note: not judged")


OVERFLOWS = Integral(count=lambda x, more: x + more + jnp.exp(100.0 + more) * 1e-60)
"""Exp(100) overflows in float, and adds 3e-17 V in double."""


@pytest.mark.parametrize("precision", ["double", "float", "compensated"])
def test_a_precision_in_which_the_loop_diverges_has_an_alarm(precision):
    system = Driven(OVERFLOWS, pj.Saturation(*LIMITS))
    report = judge(system, interface_of(), slow_runs(), precision)
    assert np.isfinite(report.references["STEP"].rms["double"])
    assert report.warnings == []
    if precision == "double":
        assert report.alarms == []
        return
    (alarm,) = report.alarms
    assert alarm == (
        "the compiled controller diverges in compensated under STEP: use double"
    )


def test_a_diverging_controller_is_exported_with_its_alarm(tmp_path):
    """Its gains are far too high, and no limit of the voltage bounds them."""
    path = tmp_path / "gains.toml"
    about = pj.About(judged=["not here"], reference_ranges=[(0.0, 10.0)])
    pj.save(pj.control.PID(1e6, 1.0, dt=1e-3), path, about)
    printed = io.StringIO()
    alarms = export_file(
        path,
        Console(file=printed, width=200),
        limits=[(-1e300, 1e300)],
        out=tmp_path / "c",
        runs=slow_runs(),
    )
    (alarm,) = alarms
    assert f"ALARM: {alarm}" in printed.getvalue()
    for name in ("controller.c", "controller.h", "report.html", "report.json"):
        assert alarm in (tmp_path / "c" / name).read_text(encoding="utf-8")
    assert "UNSAFE: the compiled" in (tmp_path / "c" / "controller.c").read_text()


@pytest.mark.parametrize("name", ["mirror", "p753_learned_inverse"])
def test_the_compiled_loop_equals_the_simulation(name):
    """Of several axes, and of one with electronics, noise and drift."""
    study = studies.load(studies.shipped(name))
    short = study.references.model_copy(update={"duration": 0.02, "settle": 0.01})
    study = study.model_copy(update={"references": short, "ensemble": None})
    case = studies.build(study, studies.shipped(name))
    data, loop = make_data(case), case.loop
    if case.study.axes is None:
        loop = dataclasses.replace(loop, controller=CONTROLLERS["p753_pid"]())
    runs = make_runs(case, holdout_of(case, loop.controller))
    found = evaluate(lambda x: x, loop, data.holdout, runs.settle).rms_error
    wanted = 1e3 * np.max(found, axis=1)
    start = jax.tree.map(lambda x: x[0], pj.Observation(*runs_start(runs, case)))
    interface = Interface(start, Seen(*start[:3]))
    report = judge(Driven(loop.controller, loop.actuator), interface, runs)
    rms = [costs.rms["double"] for costs in report.references.values()]
    np.testing.assert_allclose(rms, wanted, rtol=1e-9)


def runs_start(runs, case):
    """Return the four signals of the first start, a tuple of axes if there are any."""
    axes = case.study.axis_count
    signals = np.split(runs.starts[:, : 4 * axes], 4, axis=1)
    if case.study.axes is None:
        return [jnp.asarray(x[:, 0]) for x in signals]
    return [tuple(jnp.asarray(x[:, i]) for i in range(axes)) for x in signals]
