"""Models scheduled by the drive level, from records of several levels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.core.arrays import as_array
from piezojax.core.serial import load, read_about
from piezojax.dynamics import AmplitudeScheduled
from piezojax.identification.estimators.estimate import Options
from piezojax.report.fit_pictures import write_model
from piezojax.study import Study, build
from piezojax.tuning.evaluator import drawn_stages
from piezojax.tuning.level_stages import level_stages, levels_of

PERIOD, DT = 80, 1e-3
GAIN = np.array([[1.0, 0.2], [-0.3, 0.8]])
POLES = {0.1: 0.60, 0.4: 0.75}
"""Poles of the stage by the rms of its drive, V."""


def record(level, seed, sign=1.0):
    """Two periods in steady state: y(k+1) = a(level) y(k) + (1 - a) G u(k).

    ``sign`` is that of the second input.
    """
    random = np.random.default_rng(seed)
    size = PERIOD // 2 - 1
    phases = np.exp(2j * np.pi * random.uniform(size=(2, size)))
    lines = np.zeros((2, PERIOD // 2 + 1), complex)
    lines[:, 1:-1] = phases
    drive = np.fft.irfft(lines, PERIOD).T * [1.0, sign]
    drive *= level / np.sqrt(np.mean(drive**2))
    a, inputs = POLES[level], np.tile(drive, (6, 1))
    outputs = np.zeros_like(inputs)
    for k in range(1, len(inputs)):
        outputs[k] = a * outputs[k - 1] + (1.0 - a) * GAIN @ inputs[k - 1]
    kept = slice(4 * PERIOD, None)
    names = f"{level} V, {seed}"
    return pj.Record(inputs[kept], outputs[kept], DT, source=names, period=PERIOD)


def fitted(records, **options):
    whole = slice(0, 2 * PERIOD)
    return pj.identify(
        records,
        "amplitude_scheduled",
        train=whole,
        validate=whole,
        options=Options(order=2, steps=5) if not options else Options(**options),
    )


@pytest.fixture(scope="module")
def fit():
    # Two records of a level are orthogonal: the second input changes its sign.
    kinds = [(0.4, 0, 1.0), (0.1, 1, 1.0), (0.4, 0, -1.0), (0.1, 1, -1.0)]
    return fitted([record(*kind) for kind in kinds])


def test_records_of_two_levels_give_both_models(fit):
    system = fit.system
    assert isinstance(system, AmplitudeScheduled)
    np.testing.assert_allclose(system.levels, [0.1, 0.4], rtol=1e-6)
    for model, a in zip(system.models, POLES.values(), strict=True):
        np.testing.assert_allclose(np.abs(model.poles()), a, rtol=1e-4)
        np.testing.assert_allclose(model.dc_gain(), GAIN, rtol=1e-3)
    # The level of the model is measured, and takes time to settle.
    assert fit.report.validation.rmse_percent_of_span < 1.0


def test_the_model_maps_a_drive_to_the_next_output(fit):
    other = record(0.4, 7)
    inputs = jnp.asarray(np.tile(other.inputs, (3, 1)))
    _, outputs = pj.simulate(fit.system, inputs)
    error = np.asarray(outputs)[-2 * PERIOD - 1 : -1] - other.outputs
    assert np.std(error) < 0.01 * np.std(other.outputs)


@pytest.mark.parametrize(
    ("records", "message"),
    [
        ([record(0.1, 0), record(0.1, 1)], "one drive level, 0.1 V rms; amplitude_sch"),
        (
            [record(0.1, 0), record(0.1, 0, -1.0), record(0.4, 2)],
            r"1 records for 2 inputs.*\(records by level: 2 at 0.1, 1 at 0.4 V rms\)",
        ),
        (
            [pj.Record(np.sin(np.arange(200.0)), np.arange(200.0), DT, period=50)],
            "amplitude_scheduled is for records of several inputs or outputs",
        ),
    ],
)
def test_records_that_do_not_suffice_are_refused(records, message):
    with pytest.raises(ValueError, match=message) as caught:
        fitted(records)
    assert "\n" not in str(caught.value)


STUDY = {
    "title": "two axes",
    "rate": 1.0 / DT,
    "axes": {"names": ["X", "Y"], "units": ["um", "um"]},
    "plant": {"file": "model.json"},
    "actuator": {"lower": -10.0, "upper": 10.0},
    "controller": {
        "type": "PerAxis",
        "parts": [{"type": "PID", "proportional": 0.0, "integral": 9.0, "dt": DT}] * 2,
    },
    "references": {"tune": ["X:SIN10"], "duration": 0.1, "settle": 0.05},
    "tune": ["controller.0.integral"],
}


def test_a_saved_fit_is_the_plant_of_a_study(fit, tmp_path):
    write_model(fit, tmp_path)
    again = load(tmp_path / "model.json", accept_unsafe=True)
    for one, other in zip(again.models, fit.system.models, strict=True):
        np.testing.assert_array_equal(one.A, other.A)
    about = read_about(tmp_path / "model.json")
    STUDY["plant"]["accept_unsafe"] = bool(about.unsafe)
    case = build(Study.model_validate(STUDY), tmp_path / "study.toml")
    assert levels_of(case.loop.plant) == 2
    # Each level is a stage on which margins are limited, whatever the drive.
    stages = level_stages(case.loop)
    drive = (as_array(0.3), as_array(-5.0))
    for i, model in enumerate(fit.system.models):
        only = jax.tree.map(lambda leaf, i=i: leaf[i], stages.plant)
        _, output = only.step(only.init(drive), drive)
        np.testing.assert_allclose(
            output, np.asarray(model.dc_gain()) @ np.array([0.3, -5.0]), rtol=1e-6
        )
    assert drawn_stages(case, "margins").plant.system.levels[0].shape == (3,)
    assert drawn_stages(case, "tune") is None
