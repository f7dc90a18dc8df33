"""Change of modes with amplitude, and the commands that measure responses."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from oracles import multisines

import piezojax as pj
from piezojax.cli.identify import main
from piezojax.core.about import About
from piezojax.core.serial import read_about
from piezojax.identification.estimators.modal_model import ModalFit, ModalValue
from piezojax.identification.records.response import FrequencyResponse
from piezojax.identification.records.response_file import read_response
from piezojax.identification.response_levels import compare_levels
from piezojax.identification.response_model import ResponseModel, ResponseReport
from piezojax.report.response_pictures import measured_figure

LINES = np.geomspace(50.0, 3000.0, 60)


def level(frequency, damping, gain, amplitude=None, others=()):
    """Return the model of one mode, and of ``others``, as if it had been fitted."""
    modes = [(frequency, damping, gain), *others]

    def values(i, error):
        return tuple(ModalValue(mode[i], error * mode[i]) for mode in modes)

    fit = ModalFit(
        frequency=values(0, 1e-4),
        damping=values(1, 0.01),
        gain=values(2, 1e-3),
        share=(),
        static_gain=ModalValue(sum(mode[2] for mode in modes), 1e-3 * gain),
        lag=None,
        delay=ModalValue(1e-4, 1e-6),
        fitted=np.ones(LINES.size),
        deviation=np.full(LINES.size, 1e-6),
        excess=None,
        searched=LINES.size,
        held=None,
    )
    s = 2j * np.pi * LINES
    exact = sum(
        k * (2 * np.pi * f) ** 2 / (s**2 + 4 * np.pi * z * f * s + (2 * np.pi * f) ** 2)
        for f, z, k in modes
    ) * np.exp(-1e-4 * s)
    np.testing.assert_allclose(fit.response_at(LINES), exact)
    response = FrequencyResponse(LINES, exact, source=f"{gain}", amplitude=amplitude)
    report = ResponseReport(
        source="", unit="um/V", lines=60, found="", parameters={}, error=0, noise=0,
        notes=[],
    )  # fmt: skip
    about = About(rate_Hz=10_000.0)
    return ResponseModel(pj.Affine(gain), report, response, fit, about)


def test_the_change_of_each_mode_is_told_with_its_error():
    levels = [
        level(690.0, 0.03, 0.11, 2.0),
        level(700.0, 0.02, 0.10, 0.5),
        level(695.0, 0.02, 0.10, 1.0),
    ]
    found = compare_levels(levels)
    assert found.report.amplitudes == [0.5, 1.0, 2.0]
    gain, frequency, damping = found.report.changes
    assert gain.change_percent == pytest.approx(10.0)
    assert frequency.change_percent == pytest.approx(100.0 * (690.0 / 700.0 - 1.0))
    assert frequency.standard_error_percent == pytest.approx(
        100.0 * np.hypot(1e-4, 1e-4) * 690.0 / 700.0, rel=1e-6
    )
    assert damping.change_percent == pytest.approx(50.0)
    assert [one.certain for one in found.report.changes] == [True] * 3
    assert [one.value for one in frequency.levels] == [700.0, 695.0, 690.0]
    # The chosen model is bounded at the resonance of every level.
    at = int(np.argmin(np.abs(LINES - 692.0)))
    peak = float(LINES[at])
    own = found.models[found.report.chosen].response.values[at]
    worst = max(abs(one.response.values[at] / own - 1.0) for one in found.models)
    assert found.chosen.about.error_bound.at(peak) >= 0.999 * worst


def test_changes_below_the_errors_are_not_claimed():
    found = compare_levels([level(700.0, 0.02, 0.1), level(700.1, 0.0203, 0.1002)])
    assert not any(one.certain for one in found.report.changes)
    assert found.report.amplitudes is None
    other = level(700.0, 0.02, 0.1, others=[(1500.0, 0.02, 0.01)])
    notes = compare_levels([other, level(700.0, 0.02, 0.1)]).report.notes
    assert "the mode at 1500 Hz is not found at every amplitude" in notes
    assert "the number of modes found differs: 2, 1" in notes
    with pytest.raises(ValueError, match="two or more of one unit and rate; there are"):
        compare_levels([other])


def test_a_multisine_becomes_a_model_and_a_file_that_is_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(1)
    inputs = [np.tile(multisines.multisine(random), 4) for _ in range(3)]
    outputs = [multisines.output(u, random, 0.03, 0.01) for u in inputs]
    table = np.column_stack([np.concatenate(inputs), np.concatenate(outputs)])
    head = "drive_V,displacement_nm"
    np.savetxt("three.csv", table, "%.9g", ",", header=head, comments="")
    line = (
        "three.csv --response --method robust --realisations 3 --period 1000 "
        "--rate 10000 --out found"
    )
    done = CliRunner().invoke(main, line.split())
    assert done.exit_code == 0, done.output
    assert "nonlinear distortion of one realisation" in done.output
    report = json.loads((tmp_path / "found" / "response.json").read_text())
    assert report["measured"]["realisations"] == 3
    assert 3.0 < report["measured"]["distortion_percent"] < 12.0
    first = report["parameters"]["dynamics.frequency.0"]
    assert first["value"] == pytest.approx(700.0, abs=4.0 * first["standard_error"])
    gain = report["parameters"]["gain.gain"]
    assert gain["value"] == pytest.approx(1.09, abs=4.0 * gain["standard_error"])
    assert (tmp_path / "found" / "response.png").stat().st_size > 10_000
    back = read_response(tmp_path / "found" / "response.csv")
    assert (back.unit, back.held, back.realisations) == ("nm/V", 1e-4, 3)
    about = read_about(tmp_path / "found" / "model.json")
    assert about.units == {"input": "V", "output": "nm"}
    assert about.error_bound.excited_at(1000.0)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("r.csv --skip 2 --unit nm/V", "--unit, --skip need --response"),
        ("r.csv --response --period 9 --rate 9", "--period needs a --method"),
        (
            "r.csv --response --rate 9 --segment 64 --skip 2",
            "--skip, --segment need a --method",
        ),
        ("r.csv --response", "a file of --response needs a --rate"),
        ("r.csv --response --method welch --unit m/V", "come from the record"),
        ("r.csv --response --rate 9 --amplitude 1,2", "has 2 values for 1 responses"),
        ("r.csv --response --amplitude 1,x", "'1,x' must be numbers above 0"),
        ("r.csv --response --dynamics m.json", "--dynamics needs one model"),
    ],
)
def test_options_that_do_not_belong_together(tmp_path, monkeypatch, line, message):
    monkeypatch.chdir(tmp_path)
    table = np.column_stack([LINES, np.ones(LINES.size), -0.1 * LINES])
    head = "frequency_Hz,magnitude,phase_deg"
    np.savetxt("r.csv", table, "%.9g", ",", header=head, comments="")
    done = CliRunner().invoke(main, line.split())
    assert done.exit_code != 0
    assert message in done.output


@pytest.mark.parametrize(
    ("noise", "resolution", "label"),
    [
        (None, 0.0, "noise, 99 %"),
        (None, 2.0, "noise and distortion, 99 %"),
        (np.ones(LINES.size), 0.0, "noise and distortion, 99 %"),
    ],
)
def test_both_panels_name_the_same_causes_of_the_variance(noise, resolution, label):
    one = level(690.0, 0.03, 0.11)
    of = {"variance": np.ones(LINES.size), "noise": noise, "resolution": resolution}
    response = FrequencyResponse(LINES, one.response.values, **of)
    gain, _, residual = measured_figure(response, one.fit, "a stage").axes
    assert label in residual.get_legend_handles_labels()[1]
    above = label.removesuffix(", 99 %") if noise is None else "noise of the mean"
    assert above in gain.get_legend_handles_labels()[1]
