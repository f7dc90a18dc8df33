"""Alarms: every reason not to use tuned gains is named in output and files."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner

import piezojax as pj
from piezojax.analysis.stability import StabilityReports, axes_report_of, report_of
from piezojax.analysis.stability.assess import AxesStability
from piezojax.analysis.stability.conserved import LinearAxes, LinearLoop
from piezojax.analysis.stability.following import Following
from piezojax.analysis.stability.sampled_margins import (
    delay_margin_of,
    gain_margin_of,
    phase_margin_of,
)
from piezojax.cli.tune import main
from piezojax.core.files import write_json
from piezojax.report.robustness import constraints_table, perturbed_figure
from piezojax.report.tuning_tables import following_table, stability_table
from piezojax.tuning.alarms import DISAGREE, alarms_of, exact_peak
from piezojax.tuning.outcome import Outcome
from piezojax.tuning.result import ConstraintOutcome, Perturbed, Result, Scores
from piezojax.tuning.step_tests import StepResult

LIMITS = {"sensitivity_peak": 2.0, "delay_margin": 1.0}


def integrator(gain, delay=2):
    """Return L = gain z^-delay / (z - 1) as matrices."""
    A = np.zeros((delay + 1, delay + 1))
    A[0, 0], A[0, 1] = 1.0, 1.0
    A[range(1, delay), range(2, delay + 1)] = 1.0
    B, C = np.zeros(delay + 1), np.zeros(delay + 1)
    B[-1], C[0] = 1.0, gain
    return LinearLoop(A, B, C, 1e-4)


def peak(gain, delay=2):
    """Return max |S| of ``integrator`` on a grid, by NumPy."""
    z = np.exp(1j * np.linspace(1e-3, np.pi, 200_001))
    return np.abs(1.0 / (1.0 + gain * z**-delay / (z - 1.0))).max()


def reports(gain):
    report = report_of(integrator(gain))
    return StabilityReports(reports={"after": {"ascending": report}})


def scores(rms=1.0, saturated=0.0):
    return Scores(
        per_reference_rms_um={"SIN1": 1.0, "SW30": rms},
        geomean_rms_um=rms,
        worst_rms_um=rms,
        peak_error_um={"SIN1": 1.0, "SW30": rms},
        saturated_percent={"SIN1": 0.0, "SW30": saturated},
        peak_voltage_V=1.0,
    )


def result(**changes):
    nothing = dict.fromkeys(("study", "title", "method"), "")
    return Result.model_construct(
        **nothing | {"after": scores(), "holdout": scores()} | changes
    )


def outcome(name, values, limit):
    return ConstraintOutcome.of_values(name, limit, np.array(values))


def perturbed(unstable=0, **constraints):
    return Perturbed.model_construct(
        plants=9, unstable=unstable, constraints=constraints
    )


def alarms(result=None, stability=None, limits=LIMITS, model=()):
    return alarms_of(result or RESULT, stability or reports(0.1), limits, model)


RESULT = result(
    unseen=None, coupling=None, constraints={}, holdout_constraints={}, perturbed=None
)


def changed(**changes):
    return RESULT.model_copy(update=changes)


def test_safe_gains_raise_no_alarm():
    assert alarms(changed(holdout=scores(rms=0.99 * DISAGREE))) == []
    kept = {"sensitivity_peak": outcome("sensitivity_peak", [1.4, 1.9], 2.0)}
    assert alarms(changed(constraints=kept, perturbed=perturbed(**kept))) == []
    # The hold-out has another noise draw.
    near = {"peak_slew": outcome("peak_slew", [1.04], 1.0)}
    assert alarms(changed(holdout_constraints=near)) == []
    # The margins of the search differ from the exact ones by less than 1 %.
    exact = report_of(integrator(0.2)).sensitivity_peak
    assert alarms(stability=reports(0.2), limits={"sensitivity_peak": exact}) == []


@pytest.mark.parametrize(
    ("name", "figure", "worse"),
    [
        ("sensitivity_peak", "sensitivity_peak", 1.0),
        ("delay_margin", "delay_margin_samples", -1.0),
        ("gain_margin", "gain_margin_dB", -1.0),
        ("phase_margin", "phase_margin_deg", -1.0),
        ("disk_margin", "disk_margin", -1.0),
    ],
)
def test_an_exact_margin_may_miss_its_limit_by_one_percent(name, figure, worse):
    value = getattr(report_of(integrator(0.3)), figure)
    near, far = (value / (1.0 + worse * miss) for miss in (0.009, 0.011))
    assert alarms(stability=reports(0.3), limits={name: near}) == []
    (alarm,) = alarms(stability=reports(0.3), limits={name: far})
    assert alarm.startswith(f"{name} is ")


def step(overshoot):
    figures = ("rise_time", "settling_time", "settling_time_fine")
    return StepResult(
        before_um=1.0,
        after_um=5.0,
        overshoot=overshoot,
        **dict.fromkeys([f"{name}_s" for name in (*figures, "settling_time_noise")]),
        steady_state_error=0.0,
    )


@pytest.mark.parametrize(
    ("large", "reached"),
    [
        (1.0, None),
        (1.01, "overshoots by 101 %"),
        (3.29, "overshoots by 329 %"),
        (None, "diverges"),
    ],
)
def test_a_step_that_rings_raises_an_alarm(large, reached):
    # A small step may overshoot by far: the slope of the hysteresis changes there.
    small = {f"small step {way}": step(4.0) for way in ("up", "down")}
    found = alarms(
        changed(
            steps=small | {"large step up": step(0.5), "large step down": step(large)}
        )
    )
    if reached is None:
        assert found == []
        return
    (alarm,) = found
    assert alarm.startswith(f"a step of the reference from 1 to 5 um {reached}: limit ")
    assert "LimitedReference" in alarm


def test_a_limit_on_the_hold_out_may_be_missed_by_five_percent():
    for values, count in (([52.4], 0), ([52.5], 0), ([52.6], 1)):
        found = {"effort": outcome("effort", values, 50.0)}
        assert len(alarms(changed(holdout_constraints=found))) == count


def test_the_exact_peak_is_infinite_for_an_unstable_or_unknown_loop():
    assert exact_peak(reports(0.3)) == report_of(integrator(0.3)).sensitivity_peak
    assert exact_peak(reports(2.0)) == np.inf
    assert exact_peak(StabilityReports()) == np.inf


@pytest.mark.parametrize(
    ("alarms", "heading"),
    [
        ([], "a lag"),
        (["it rings"], "UNSAFE, an alarm: a lag"),
        (["it rings", "it rails"], "UNSAFE, 2 alarms: a lag"),
    ],
)
def test_the_heading_counts_the_alarms(alarms, heading):
    assert changed(title="a lag", alarms=alarms).heading == heading


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"after": scores(rms=None)}, "diverges on tuning runs of SW30: reduce the"),
        (
            {"holdout": scores(saturated=91.0)},
            "stays at a limit of the voltage or of its slew rate on hold-out runs of "
            "SW30: reduce",
        ),
        ({"unseen": scores(rms=None)}, "diverges on unseen runs of SW30"),
        (
            {"holdout": scores(rms=1.01 * DISAGREE)},
            "the errors on the hold-out are 5.05 times those of tuning: the gains suit",
        ),
        ({"coupling": scores(rms=None)}, "diverges on resting runs of SW30"),
        (
            {"holdout_constraints": {"effort": outcome("effort", [53.0], 50.0)}},
            r"effort is 53 V rms on the hold-out, above its limit 50 V rms",
        ),
        (
            {"constraints": {"effort": outcome("effort", [99.0], 50.0)}},
            "effort is 99 V rms on 1 of 1 tuned plants, above its limit 50 V rms: be",
        ),
        (
            {"holdout_constraints": {"peak_slew": outcome("peak_slew", [2e4], 1e4)}},
            "above its limit 10000 V/s: record faster motions (python -m piezojax.exc",
        ),
        (
            {"perturbed": perturbed(effort=outcome("effort", [1.0, math.nan], 50.0))},
            "effort is not known on 1 of 2 held-out plants, above its limit 50 V rms: "
            "draw more plants",
        ),
        (
            {"perturbed": perturbed(unstable=2)},
            "diverges or stays at a voltage limit on 2 of 9 perturbed plants: raise "
            "ensemble.tune",
        ),
    ],
)
def test_every_alarm_has_a_cause_and_a_next_step(changes, message):
    (alarm,) = alarms(changed(**changes))
    assert message in alarm


@pytest.mark.parametrize(
    ("stability", "message"),
    [
        (
            reports(0.45),
            f"sensitivity_peak is {peak(0.45):.3g} on the nominal plant on the ascendi",
        ),
        (reports(2.0), "the tuned loop is unstable for small motions on the ascending"),
        (
            StabilityReports(problems={"after": "the loop has no finite derivative"}),
            "the margins of the tuned loop are unknown, because the loop has no finite",
        ),
    ],
)
def test_exact_margins_beyond_a_limit_raise_an_alarm(stability, message):
    found = alarms(stability=stability)
    assert message in found[0]
    # Without limits on margins only an unstable loop is an alarm.
    unlimited = alarms(stability=stability, limits={})
    assert [alarm for alarm in unlimited if "unstable" not in alarm] == []
    assert bool(unlimited) == ("unstable" in message)


@pytest.mark.parametrize(
    ("name", "limit", "held"),
    [
        *(("bandwidth", 300.0, True), ("bandwidth", 500.0, False)),
        *(("closed_loop_peak", 1.3, True), ("closed_loop_peak", 1.1, False)),
    ],
)
def test_following_the_reference_is_checked_exactly(name, limit, held):
    followed = Following(400.0, 200.0, 1.2, 350.0)
    report = replace(report_of(integrator(0.1)), following=followed)
    stability = StabilityReports(reports={"after": {"ascending": report}})
    found = alarms(stability=stability, limits={name: limit})
    assert [alarm.partition(" ")[0] for alarm in found] == [name] * (not held)


def test_a_response_that_is_not_known_leaves_the_outcome_of_the_search():
    """A mode that does not decay hides y/r, not the limits on it."""
    known = replace(
        report_of(integrator(0.1)), following=Following(400.0, 200.0, 1.2, 350.0)
    )
    unknown = report_of(integrator(0.1))
    assert unknown.stable
    assert unknown.following is None
    limits = {"bandwidth": 300.0, "closed_loop_peak": 1.5}
    missed = {
        "bandwidth": outcome("bandwidth", [250.0], 300.0),
        "closed_loop_peak": outcome("closed_loop_peak", [1.9], 1.5),
    }
    for branches, count in (((unknown,), 2), ((known, unknown), 2), ((known,), 0)):
        named = dict(zip(("ascending", "descending"), branches, strict=False))
        stability = StabilityReports(reports={"after": named})
        found = alarms(changed(constraints=missed), stability, limits)
        assert len(found) == count
        shown = "".join(following_table(stability).columns[1].cells)
        assert shown == ("-" if unknown in branches else "400 Hz")
    (alarm,) = alarms(changed(constraints=missed), reports(2.0), limits)
    assert "unstable for small motions" in alarm
    assert [*following_table(reports(2.0)).columns[1].cells] == ["unstable"]


def test_lower_limits_are_violated_from_below():
    exact = report_of(integrator(0.2)).delay_margin_samples
    for factor, expected in ((0.995, 0), (1.005, 0), (1.03, 1)):
        limits = {"delay_margin": factor * exact}
        found = alarms(stability=reports(0.2), limits=limits)
        assert len(found) == expected
    near = {"disk_margin": outcome("disk_margin", [0.96], 1.0)}
    assert alarms(changed(holdout_constraints=near)) == []
    low = {"disk_margin": outcome("disk_margin", [0.85], 1.0)}
    (alarm,) = alarms(changed(holdout_constraints=low))
    assert "disk_margin is 0.85 on the hold-out, below its limit 1" in alarm


def test_a_run_is_saturated_from_a_share_of_its_samples():
    (alarm,) = alarms(changed(holdout=scores(saturated=90.1)))
    assert alarm.startswith(
        "the tuned loop stays at a limit of the voltage or of its slew rate on "
        "hold-out runs of SW30"
    )
    assert alarms(changed(holdout=scores(saturated=89.9))) == []


def test_each_branch_is_checked():
    branches = {
        "ascending": report_of(integrator(2.0)),
        "descending": report_of(integrator(0.45)),
    }
    found = alarms(stability=StabilityReports(reports={"after": branches}))
    first, second = found[:2]
    assert "unstable for small motions on the ascending branch" in first
    assert second.startswith("sensitivity_peak is ")
    assert "on the nominal plant on the descending branch" in second


def test_exact_margins_replace_those_of_the_nominal_plant_only():
    def missed(*values):
        figure = outcome("sensitivity_peak", values, 2.0)
        return changed(constraints={"sensitivity_peak": figure})

    assert alarms(missed(2.1)) == []
    (alarm,) = alarms(missed(1.9, 2.1))
    assert alarm.startswith("sensitivity_peak is 2.1 on 1 of 2 tuned plants, above")
    unknown = StabilityReports(problems={"after": "it has no derivative"})
    assert any("2.1 on 1 of 1 tuned" in a for a in alarms(missed(2.1), unknown))


def test_the_cut_at_the_displacements_is_checked_on_several_axes():
    """Two linear loops replace the cuts: only that at the outputs exceeds the limit."""
    A, B, C = np.zeros((1, 1)), np.array([[1.0, 0.0]]), np.array([[0.1], [0.9]])
    before = LinearAxes(A, B, C, 1e-4)
    behind = LinearAxes(A, B, 3.0 * C, 1e-4)
    report = axes_report_of(before, behind)
    peaks = report.sensitivity_peak, report.output_sensitivity_peak
    assert peaks[0] < 2.0 < peaks[1]
    axes = AxesStability(report, before)
    (alarm,) = alarms(stability=StabilityReports(axes={"after": axes}))
    assert alarm.startswith(f"sensitivity_peak is {peaks[1]:.3g} on the nominal plant,")


def test_the_worst_margins_of_both_branches_are_checked_on_several_axes():
    """The branch with the larger disk margin has the smaller delay margin."""
    cuts = [
        LinearAxes(loop.A, loop.B[:, None], loop.C[None], loop.dt)
        for loop in (integrator(0.28), integrator(0.45, delay=1))
    ]
    found = [axes_report_of(cut) for cut in cuts]
    low, high = (report.axes[0] for report in found)
    assert low.disk_margin < high.disk_margin
    assert high.delay_margin_samples < 2.8 < low.delay_margin_samples
    both = AxesStability(found[0], cuts[0], found[1])
    stability = StabilityReports(axes={"after": both}, axis_names=("X",))
    # The search found the same, but the exact figures replace its outcome.
    missed = {"delay_margin": outcome("delay_margin", [2.0], 2.8)}
    limits = {
        "sensitivity_peak": 1.01 * low.sensitivity_peak,
        "disk_margin": 0.99 * low.disk_margin,
        "delay_margin": 2.8,
    }
    (alarm,) = alarms(changed(constraints=missed), stability, limits)
    margin = f"{high.delay_margin_samples:.3g} samples"
    assert alarm.startswith(f"delay_margin is {margin} on the nominal plant, below")
    shown = [*stability_table(stability).columns[4].cells]
    assert shown == [f"{high.delay_margin_samples:.2f} samples", "-"]
    peak, largest = [*stability_table(stability).columns[1].cells]
    assert peak == largest == f"{low.sensitivity_peak:.2f}"
    figures = stability.as_dict()["after"]
    assert figures["disk_margin"] == found[0].disk_margin
    assert figures["other_branch"]["disk_margin"] == found[1].disk_margin
    # An unstable branch is worse than any margin.
    lost = axes_report_of(LinearAxes(2.0 * np.eye(1), *np.ones((2, 1, 1)), 1e-4, 0))
    assert not lost.stable
    unstable = StabilityReports(axes={"after": AxesStability(lost, cuts[0], found[1])})
    (alarm,) = alarms(changed(constraints=missed), unstable, limits)
    assert alarm.startswith("the tuned loop is unstable for small motions:")


def test_a_margin_of_nan_is_an_alarm():
    report = replace(report_of(integrator(0.1)), sensitivity_peak=math.nan)
    stability = StabilityReports(reports={"after": {"descending": report}})
    (alarm,) = alarms(stability=stability)
    assert alarm.startswith("sensitivity_peak is nan on the nominal plant on the desc")


def test_alarms_of_a_fit_are_alarms_of_the_gains():
    missed = ["the model misses a mode at 780 Hz: add it"]
    assert alarms(model=missed) == missed


def test_margins_that_nothing_limits_are_unlimited_in_every_text():
    """S of a loop that hardly acts: |L| stays below 1, and L off the negative axis."""
    angle = np.linspace(0.0, np.pi, 500)
    loop = 0.01 * (1.0 - 0.5 * np.exp(-1j * angle)) ** -1
    S = (1.0 / (1.0 + loop))[:, None, None]
    found = {
        "delay_margin": delay_margin_of(S),
        "gain_margin": gain_margin_of(S),
        "phase_margin": phase_margin_of(S),
        "sensitivity_peak": 1.25,
    }
    limits = {name: 1.0 if "peak" not in name else 2.0 for name in found}
    kept = {
        name: outcome(name, [float(value)] * 3, limits[name])
        for name, value in found.items()
    }
    values = {name: [float(value)] * 3 for name, value in found.items()}
    values["delay_margin"][0] = 3.5
    drawn = perturbed(**kept).model_copy(
        update={
            "plants": 3,
            "values": values,
            "geomeans_um": [1.0] * 3,
            "geomeans_before_um": [2.0] * 3,
        }
    )
    found = changed(constraints=kept, perturbed=drawn)
    table = constraints_table(found)
    assert [*table.columns[1].cells] == ["1 samples", "1 dB", "1 deg", "2"]
    assert [*table.columns[2].cells] == [*["unlimited"] * 3, "1.25"]
    assert [*table.columns[4].cells] == [
        *["unlimited, kept on 3 of 3"] * 3,
        "1.25, kept on 3 of 3",
    ]
    judged = Outcome.judged.fget(SimpleNamespace(stability=reports(0.1), result=found))
    assert judged[1:] == [
        *(f"{name} unlimited on the worst of 3 tuning plants" for name in [*kept][:3]),
        "sensitivity_peak 1.25 on the worst of 3 tuning plants",
        *(
            f"{name} unlimited on the worst of 3 held-out plants"
            for name in [*kept][:3]
        ),
        "sensitivity_peak 1.25 on the worst of 3 held-out plants",
    ]
    first, *panels = perturbed_figure(drawn, "", ("um", "urad")).axes
    assert first.get_xlabel().endswith("over references, nm or nrad")
    for panel, lost in zip(panels, (2, 3, 3, 0), strict=True):
        curve = panel.lines[0]
        assert len(curve.get_xdata()) == 3 - lost
        shown = f"tuned, unlimited on {lost}" if lost else "tuned"
        assert curve.get_label() == shown
    # The exact margins of the nominal plant are infinite.
    still = LinearLoop(np.array([[0.5]]), np.ones(1), np.array([-0.01]), 1e-4)
    stability = StabilityReports(reports={"after": {"ascending": report_of(still)}})
    assert [*stability_table(stability).columns[3].cells] == ["unlimited"]
    assert [*stability_table(stability).columns[4].cells] == ["unlimited"]


def test_json_contains_null_for_nan(tmp_path):
    content = {"a": [1.0, math.nan], "b": (math.inf,), "c": {"d": "x", "e": None}}
    write_json(tmp_path / "a.json", content)
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "a": [1.0, None],
        "b": [None],
        "c": {"d": "x", "e": None},
    }


STUDY = {
    "title": "gains that cannot keep their limit",
    "rate": 20_000.0,
    "plant": {
        "type": "Series",
        "parts": [
            {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5},
            {"type": "Delay", "samples": 4},
        ],
    },
    "actuator": {"lower": -20.0, "upper": 120.0},
    "controller": {"type": "PID", "proportional": 0.0, "integral": 3e3, "dt": 5e-5},
    "references": {
        "tune": ["SW50"],
        "amplitude": 2.0,
        "duration": 0.06,
        "settle": 0.02,
    },
    "parameters": {"controller.integral": {"lower": 2e3, "upper": 4e3, "scale": "log"}},
    "optimiser": {"method": "gauss_newton", "starts": 1, "candidates": 2, "steps": 2},
    "constraints": {"sensitivity_peak": 1.2},
}


@pytest.mark.usefixtures("undrawn")
def test_the_command_ends_with_the_alarm(tmp_path):
    study, out = tmp_path / "study.toml", tmp_path / "out"
    study.write_text(tomli_w.dumps(STUDY), encoding="utf-8")
    ended = CliRunner().invoke(main, ["--no-sliders", str(study), "--out", str(out)])
    assert ended.exit_code == 3
    printed = [
        line for line in ended.output.splitlines() if "sensitivity_peak is" in line
    ]
    assert printed[0].startswith("ALARM: sensitivity_peak is ")
    assert ended.output.index("ALARM") < ended.output.index("rms tracking error")
    assert "UNSAFE" in ended.output
    kept = json.loads((out / "result.json").read_text())
    assert kept["alarms"][0] == printed[0].removeprefix("ALARM: ")
    with pytest.raises(
        ValueError, match=r"gains.toml was written with .*: sensitivity"
    ):
        pj.load(out / "gains.toml")
    assert pj.load(out / "gains.toml", accept_unsafe=True).integral > 1.9e3
    assert pj.read_about(out / "gains.toml").unsafe == kept["alarms"]
