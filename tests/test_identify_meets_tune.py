"""Every model of identify, as the plant of a study with every design."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w

import piezojax as pj
from piezojax.control.design import DESIGNS
from piezojax.core.registry import parts
from piezojax.core.system import rest_output
from piezojax.dynamics import ARMA, FirstOrderLag
from piezojax.hysteresis import (
    BoucWen,
    ColemanHodgdon,
    HystereticARMA,
    HystereticOscillator,
    Preisach,
    RateDependentPreisach,
)
from piezojax.identification import METHODS
from piezojax.identification.automatic import automatic
from piezojax.identification.chain import DEFAULT, structure
from piezojax.identification.estimators.neural import neural_start
from piezojax.study import read

DT = 1e-3
LIMITS = (0.0, 100.0)
INTEGRAL = {
    "inversion_sliding_mode": "controller.feedback.law.integral",
    "disturbance_observer_sliding_mode": "controller.feedback.law.integral",
    "inversion_pid": "controller.feedback.integral",
}

DYNAMIC = "no inverse of the hysteresis from 0 to 100 V: a {} contains dynamics"
REFUSED = {
    (model, design): DYNAMIC.format(kind)
    for model, kind in {
        "learned_operator": "LearnedOperator with past outputs",
        "bouc_wen": "HystereticOscillator",
    }.items()
    for design in ("inversion_sliding_mode", "inversion_pid")
}

SLOW_TO_COMPILE = (
    "prandtl_ishlinskii",
    "stop_prandtl_ishlinskii",
    "rate_dependent_prandtl_ishlinskii",
)
"""Models whose inverse in a loop is checked at the start only."""


@cache
def record():
    """Return a record of hysteresis and a lag of 3 samples, in two sweeps."""
    time = DT * np.arange(400)
    swing = np.where(time < 0.2, 1.0, 0.6)
    u = 50.0 - 40.0 * swing * np.cos(2 * np.pi * 10 * time)
    u = u + 8.0 * np.sin(2 * np.pi * 60 * time)
    stage = pj.series(
        hysteresis=ColemanHodgdon(0.0077, 0.1167, -0.0487),
        lag=FirstOrderLag(3 * DT, DT),
    )
    y = np.asarray(pj.simulate(stage, jnp.asarray(u), stage.init(0.0))[1])
    return pj.Record(u, np.concatenate([[0.0], y[:-1]]), DT, period=200)


def preisach():
    weights = np.tril(np.full((5, 5), 0.6))
    return Preisach(weights + np.diag(np.full(5, 0.6)), *LIMITS)


LAG = FirstOrderLag(3 * DT, DT)
WHOLE_MODELS = {
    "hysteretic_arma": lambda: HystereticARMA(
        -0.0487, (0.7,), (0.0023, 0.0), (0.035, 0.0), 1.0
    ),
    "preisach": lambda: pj.series(hysteresis=preisach(), lag=LAG),
    "rate_dependent_preisach": lambda: pj.series(
        hysteresis=RateDependentPreisach(preisach(), 0.9 * preisach().weights, 2e4, DT),
        lag=LAG,
    ),
    "state_space": lambda: pj.series(
        dynamics=ARMA((1.5, -0.6, 0.05), (0.003, 0.004, 0.001)),
        calibration=pj.Affine(1.0, 2.0),
    ),
    "bouc_wen": lambda: HystereticOscillator(
        2e-5, 2e-3, 5.0, BoucWen(2.0, 5.0, 3.0, 1.0), DT
    ),
    "neural_state_space": lambda: neural_start(record(), 2, 4),
}
"""Models that are not chains of parts, with the sizes of a fit."""


@cache
def plant(model):
    """Return the first guess of a model in a fit."""
    if model in WHOLE_MODELS:
        return WHOLE_MODELS[model]()
    shape = structure(model, record())
    return shape.space.put(shape.system, jnp.asarray(shape.starts[0]))


def models():
    whole = {model for method in METHODS.values() for model in method.models}
    whole.remove("amplitude_scheduled")  # of several channels; designs are for one
    names = [automatic(record()).model, *parts(), *sorted(whole)]
    return list(dict.fromkeys(names))


def loop_around(controller, system):
    actuator, sensor = pj.Saturation(*LIMITS), pj.Sensor(0.0)
    return pj.Feedback(controller, system, actuator, sensor)


def started(loop):
    """Return the loop at rest in the middle of the limits, and its reference."""
    reference = rest_output(loop.plant, 50.0)
    return loop.init(reference, jnp.asarray(50.0)), reference


@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize("model", models())
def test_every_model_has_every_design_or_a_reason(model, design):
    reason = REFUSED.get((model, design))
    if reason:
        with pytest.raises(ValueError, match=reason) as caught:
            DESIGNS[design](plant(model), DT, LIMITS)
        assert "\n" not in str(caught.value)
        return
    loop = loop_around(DESIGNS[design](plant(model), DT, LIMITS), plant(model))
    state, reference = started(loop)
    span = abs(float(rest_output(plant(model), 60.0) - reference))
    if model in SLOW_TO_COMPILE or design == "inversion_sliding_mode":
        inputs = pj.core.feedback.LoopInput(reference, jnp.asarray(0.0))
        for _ in range(2):
            state, sample = loop.step(state, inputs)
            assert abs(float(sample.voltage) - 50.0) < 1e-6
        return
    # rest, then a step of a tenth of the motion for 10 V
    references = reference + jnp.where(jnp.arange(400) < 50, 0.0, 0.1 * span)
    _, samples = pj.simulate(loop, pj.loop_inputs(references), state)
    error = np.abs(np.asarray(samples.reference - samples.displacement)) / span
    assert error[:50].max() < 1e-9
    assert error.max() < 0.11
    assert error[-20:].max() < 0.02


# From a record to gains


REFERENCES = {
    "tune": ["SIN20"],
    "unseen": ["SIN10"],
    "amplitude": 0.2,
    "offset": 6.0,
    "duration": 0.1,
    "settle": 0.05,
}


def study(folder, design, stage):
    """Write a study of few samples and 10 steps."""
    path = folder / f"{design}.toml"
    content = {
        "title": "identify meets tune",
        "rate": 1.0 / DT,
        "seed": 1,
        "plant": stage,
        "actuator": dict(zip(("lower", "upper"), LIMITS, strict=True)),
        "sensor": {"noise_rms": 0.001},
        # Margins take long to compile; here a smaller error suffices.
        "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
        "controller": {"design": design},
        "references": REFERENCES,
        "parameters": {INTEGRAL[design]: {"lower": 1e-2, "upper": 1e3, "scale": "log"}},
        "optimiser": {"method": "bfgs", "starts": 1, "candidates": 2, "steps": 10},
    }
    path.write_text(tomli_w.dumps(content), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Return the folder of a fitted default model, and the Case of its record."""
    folder = tmp_path_factory.mktemp("stage")
    rows = [f"{k * DT:.6f},{u:.12g},{y:.12g}" for k, (u, y) in enumerate(samples())]
    (folder / "record.csv").write_text("\n".join(["time_s,input_V,output_um", *rows]))
    stage = {
        "record": "record.csv",
        "model": DEFAULT,
        "time": "time_s",
        "input": "input_V",
        "output": "output_um",
        "train": [0, 300],
    }
    case = read(study(folder, "inversion_sliding_mode", stage))
    pj.save(case.fit.system, folder / "model.json")
    return folder, case


def samples():
    return zip(record().input, record().output, strict=True)


@pytest.mark.parametrize("design", DESIGNS)
def test_the_default_model_is_tuned_with_every_design(fitted, design):
    folder, case = fitted
    if design != "inversion_sliding_mode":
        case = read(study(folder, design, {"file": "model.json"}))
    result = pj.tune(case).result
    assert result.after.geomean_rms_um < result.before.geomean_rms_um


def test_a_model_without_hysteresis_is_tuned(tmp_path):
    pj.save(plant("lag"), tmp_path / "model.json")
    result = pj.tune(study(tmp_path, "inversion_pid", {"file": "model.json"})).result
    assert result.after.geomean_rms_um < result.before.geomean_rms_um
