"""Coupling of axes, and the pictures of coupling and contours."""

import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.core.feedback import LoopSample
from piezojax.report import tuning_pictures as tuning
from piezojax.report.contour_path import contour_figure
from piezojax.report.coupling_map import coupling_figure
from piezojax.report.figures import plot_style
from piezojax.signals import waveforms as signals
from piezojax.study import Study, build
from piezojax.tuning import coupling_matrix
from piezojax.tuning.contouring import contour_errors, contours_in
from piezojax.tuning.outcome import Outcome
from piezojax.tuning.result import Result, Scores
from piezojax.tuning.runs import Signals
from piezojax.tuning.traces import traces_of

TUNE = ["Z:SIN5", "Rx:SIN5", "Ry:SIN5", "Ry:SIN10", "Z+Rx:CIRCLE5"]
BASE = {
    "title": "a PID on the stage",
    "rate": 500.0,
    "axes": {"names": ["Z", "Rx", "Ry"], "units": ["um", "urad", "urad"]},
    "plant": {"catalog": "p558"},
    "actuator": {"lower": -300.0, "upper": 300.0},
    "controller": {"catalog": "p558_pid"},
    "references": {
        "tune": TUNE,
        "unseen": ["Rx+Ry:CIRCLE10"],
        "amplitude": [5.0, 40.0, 20.0],
        "duration": 0.2,
        "settle": 0.1,
    },
    "parameters": {"controller.Z.integral": {"lower": 1.0, "upper": 400.0}},
}
ONE_AXIS = BASE | {
    "axes": None,
    "rate": 20_000.0,
    "plant": {"catalog": "p753"},
    "controller": {"catalog": "p753_pid"},
    "parameters": {"controller.integral": {"lower": 100.0, "upper": 2e4}},
    "references": {"tune": ["SIN5"], "duration": 1.0},
}


def study_of(data=BASE):
    return Study.model_validate(data)


ERRORS = {
    **{"Z:SIN5": 0.5, "Z:SIN5 (Rx)": 0.01, "Z:SIN5 (Ry)": 0.02},
    **{"Rx:SIN5": 4.0, "Rx:SIN5 (Z)": 0.03, "Rx:SIN5 (Ry)": 0.2},
    **{"Ry:SIN5": 3.0, "Ry:SIN5 (Z)": 0.1, "Ry:SIN5 (Rx)": 0.3},
    **{"Ry:SIN10": 4.0, "Ry:SIN10 (Z)": 0.7, "Ry:SIN10 (Rx)": None},
    **{"Z+Rx:CIRCLE5 (Z)": 99.0, "Z+Rx:CIRCLE5 (Rx)": 99.0, "Rx+Ry:CIRCLE10 (Z)": 9.0},
}


def test_the_matrix_contains_each_axis_driven_alone():
    found = coupling_matrix(study_of(), ERRORS)
    expected = [
        [0.5, 0.01, 0.02],
        [0.03, 4.0, 0.2],
        [np.sqrt(0.25), np.nan, np.sqrt(12.5)],
    ]
    np.testing.assert_allclose(found.errors, expected, rtol=1e-12)
    assert found.names == ("Z", "Rx", "Ry")
    assert found.units == ("um", "urad", "urad")
    shares = 100.0 * np.array(expected) / np.array([[5.0], [40.0], [20.0]])
    np.testing.assert_allclose(found.percent, shares, rtol=1e-12)


def test_axes_never_driven_alone_are_unknown():
    driven_alone = {name: e for name, e in ERRORS.items() if not name.startswith("Rx:")}
    found = coupling_matrix(study_of(), driven_alone).errors
    assert np.all(np.isnan(found[1]))
    assert np.all(np.isfinite(found[0]))


def test_one_axis_has_no_coupling():
    study = study_of(ONE_AXIS)
    with pytest.raises(ValueError, match="the study has one axis; coupling needs sev"):
        coupling_matrix(study, {})
    assert contours_in(study) == []
    assert outcome_of(study).coupling is None
    assert coupling_figure(None, "") is None
    assert contour_errors(study, {}) == []
    assert contour_figure(study, "", []) is None


def test_frequencies_of_contours_are_checked():
    references = BASE["references"] | {"tune": ["Rx+Ry:CIRCLE300"]}
    with pytest.raises(ValueError, match="CIRCLE300 is not below half the rate"):
        study_of(BASE | {"references": references})


def test_a_contour_gives_traces_of_both_axes():
    traces = [t for t in traces_of(study_of()) if t.name.startswith("Rx+Ry")]
    assert [(t.name, t.driven) for t in traces] == [
        ("Rx+Ry:CIRCLE10 (Z)", False),
        ("Rx+Ry:CIRCLE10 (Rx)", True),
        ("Rx+Ry:CIRCLE10 (Ry)", True),
    ]


def scores(errors):
    return Scores(
        per_reference_rms_um=errors,
        geomean_rms_um=1.0,
        worst_rms_um=1.0,
        peak_error_um=errors,
        saturated_percent=dict.fromkeys(errors, 0.0),
        peak_voltage_V=1.0,
    )


def result_of(study):
    driven = {t.name: ERRORS.get(t.name, 1.0) for t in traces_of(study) if t.driven}
    rest = {t.name: ERRORS.get(t.name, 1.0) for t in traces_of(study) if not t.driven}
    one = scores(driven)
    return Result(
        **{"study": "s", "title": study.title, "status": "converged", "method": "bfgs"},
        **{"gains": {}, "start": {}, "at_bound": [], "warnings": [], "history": []},
        **{"before": one, "after": one, "holdout_before": one, "holdout": one},
        **{"unseen_before": None, "unseen": None, "units": {}, "versions": {}},
        **{"evaluations": 0, "compile_s": 0.0, "wall_s": 0.0, "seed": 0},
        coupling_before=scores(rest) if rest else None,
        coupling=scores(rest) if rest else None,
    )


def outcome_of(study):
    case = build(study, "small.toml", seed=None)
    nothing = Signals(jnp.zeros((1, 1)), jnp.zeros((1, 1, 1)))
    return Outcome(result_of(study), case.loop, case.loop, case, nothing)


def texts(ax):
    return [text.get_text() for text in ax.texts]


def test_coupling_picture_has_shares_and_values_with_units():
    study = study_of()
    with plot_style():
        picture = coupling_figure(outcome_of(study).coupling, study.title)
    before, tuned = picture.axes[:2]
    expected = [
        *("10 %\n500 nm", "2 nrad/µm\n10 nrad", "4 nrad/µm\n20 nrad"),
        *("0.75 nm/µrad\n30 nm", "10 %\n4 µrad", "0.5 %\n200 nrad"),
        *("25 nm/µrad\n500 nm", "-", "17.7 %\n3.54 µrad"),
    ]
    assert texts(before) == texts(tuned) == expected
    labels = [label.get_text() for label in before.get_yticklabels()]
    assert labels == ["Z\n5 µm", "Rx\n40 µrad", "Ry\n20 µrad"]


def test_contour_picture_magnifies_the_distance_not_the_lag():
    study = study_of()
    # Z and Rx have different units: there is no distance.
    (contour,) = contours_in(study)
    assert contour.run == 5
    assert contour.axes == (1, 2)
    angles = 2.0 * np.pi * 10.0 * np.arange(100) / 500.0
    middle = np.array([40.0, 20.0])  # of the contour, an ellipse of Rx and Ry

    def log(shrunk, lag):
        # an offset inwards along the normal of the ellipse, for any lag
        turned = angles - lag
        on = np.stack([-40.0 * np.cos(turned), 20.0 * np.sin(turned)])
        inwards = -np.stack([on[0] / 1600.0, on[1] / 400.0])
        inwards /= np.linalg.norm(inwards, axis=0)
        points = (0.0 * angles, *(middle[:, None] + on + shrunk * inwards))
        return LoopSample(points, points, points, points, points)

    with plot_style():
        found = contour_errors(study, {5: (log(0.0, 0.3), log(0.1, 0.0))})
        picture = contour_figure(study, "t", found)
    left, right = picture.axes
    assert "magnified 100 times" in left.get_title()
    _, before, tuned = (line.get_xydata() for line in left.lines)
    ratio = np.linalg.norm((before - middle) / [40.0, 20.0], axis=1)
    np.testing.assert_allclose(ratio, 1.0, rtol=0.002)
    inside = np.linalg.norm((tuned - middle) / [40.0, 20.0], axis=1)
    assert np.all(inside < 0.85)
    assert right.get_ylabel() == "distance from the contour (nrad)"
    assert np.all(right.lines[0].get_ydata() < 0.5)
    np.testing.assert_allclose(right.lines[1].get_ydata(), 100.0, rtol=0.005)

    lost = log(1e8, 0.0)
    lost.displacement[1][60:] = np.nan  # as a diverging run is drawn
    with plot_style():
        found = contour_errors(study, {5: (lost, log(0.1, 0.0))})
        picture = contour_figure(study, "t", found)
    assert "magnified 100 times" in picture.axes[0].get_title()
    assert np.abs(picture.axes[0].get_xlim()).max() < 120.0
    labels = picture.axes[1].get_legend_handles_labels()[1]
    assert labels[0] == "before"
    assert labels[1].endswith("nrad rms")


def test_results_of_several_axes_have_both_pictures(tmp_path):
    references = BASE["references"] | {"tune": ["Rx+Ry:CIRCLE10"], "unseen": []}
    case = build(study_of(BASE | {"references": references}), "small.toml", seed=None)
    time = signals.time_grid(0.2, 500.0)
    paths = jnp.zeros((1, 100, 3)).at[0, :, 1].set(signals.sine(time))
    holdout = Signals(paths, jnp.zeros((1, 1, 100, 3)), traces=((0, 0), (0, 1), (0, 2)))
    result = result_of(case.study)
    outcome = Outcome(result, case.loop, case.loop, case, holdout)
    tuning.write_results(outcome, tmp_path)
    # No axis is driven alone and there is no step, so these two are missing.
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        *("result.json", "gains.toml", "study.toml"),
        *("tracking.png", "hysteresis.png", "contour.png"),
    }
