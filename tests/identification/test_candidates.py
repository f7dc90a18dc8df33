"""Choice of the models that a record supports."""

import numpy as np
import pytest
import scipy.signal

from piezojax import (
    Record,
)
from piezojax.core.recipe import PLACES
from piezojax.core.registry import parts
from piezojax.identification import METHODS
from piezojax.identification.candidates import (
    first_round,
    later_rounds,
    parts_at,
    supported_parts,
)
from piezojax.identification.estimators.estimate import Options

HYSTERESIS = parts_at("hysteresis")
OWN_DYNAMICS = [name for name in HYSTERESIS if parts()[name].dynamic]
OPTIONS = Options()
HALF = slice(0, 1000)


def sines(frequencies, samples=2000, dt=1e-3, **more):
    time = np.arange(samples) * dt
    input = sum(np.sin(2 * np.pi * f * time + f) for f in frequencies)
    return Record(input, 0.1 * input + 1.0, dt, source="made up", **more)


RICH, ONE = sines((2.0, 9.0, 31.0, 77.0)), sines((2.0,))


def models(candidates):
    return [candidate.model for candidate in candidates]


def reasons(untried):
    return {one.model: one.reason for one in untried}


def test_every_hysteresis_is_tried_with_the_dynamics_of_the_record():
    found, untried = first_round([RICH], HALF, OPTIONS)
    chains = [
        f"{name}+exponential_creep{'' if name in OWN_DYNAMICS else '+arma'}"
        for name in HYSTERESIS
        if name != "preisach"  # a whole model, with weights that it determines
    ]
    assert models(found)[: len(chains) + 1] == ["exponential_creep+arma", *chains]
    assert {"hysteretic_arma", "state_space"} <= set(models(found))
    assert set(reasons(untried)) >= {"bouc_wen", "neural_state_space"}


def test_named_models_are_tried_with_linear_models():
    names = ["hysteretic_arma", "prandtl_ishlinskii", "bouc_wen"]
    found, untried = first_round([RICH], HALF, OPTIONS, names)
    assert set(models(found)) == {
        "exponential_creep+arma",
        "prandtl_ishlinskii+exponential_creep+arma",
        "hysteretic_arma",
        "state_space",
    }
    assert set(reasons(untried)) == {"bouc_wen"}


def test_named_models_that_cannot_be_tried_are_refused():
    with pytest.raises(ValueError, match="none of the named models can be tried: bouc"):
        first_round([RICH], HALF, OPTIONS, ["bouc_wen"])


def test_every_omitted_model_has_a_reason():
    for record in (RICH, ONE, sines((2.0,), period=500), sines((3.0,), 200)):
        found, untried = first_round([record], slice(0, record.samples // 2), OPTIONS)
        named = {part for model in models(found) for part in model.split("+")}
        whole = {model for method in METHODS.values() for model in method.models}
        assert {*HYSTERESIS, *whole} <= named | set(reasons(untried))
        assert all(reasons(untried).values())


def test_one_frequency_excludes_second_order_dynamics():
    found, untried = first_round([ONE], HALF, OPTIONS)
    assert "1 frequency in the training part" in reasons(untried)["arma"]
    assert "state_space" in reasons(untried)
    assert "hysteretic_arma" in reasons(untried)
    assert all(
        model.endswith("+lag") or model.split("+")[0] in OWN_DYNAMICS
        for model in models(found)
    )


def test_dynamics_without_a_shown_resonance_are_not_tried():
    # A mode at 60 Hz behind a step, and one frequency.
    w, dt = 2.0 * np.pi * 60.0, 1e-3
    time = np.arange(2000) * dt
    input = np.sin(2.0 * np.pi * 2.0 * time) + np.where(time > 0.1, 5.0, 0.0)
    mode = ([w**2], [1.0, 0.04 * w, w**2])
    b, a, _ = scipy.signal.cont2discrete(mode, dt)
    output = scipy.signal.lfilter(b[0], a, input)
    output += 1e-3 * np.random.default_rng(0).standard_normal(2000)
    behind, untried = supported_parts([Record(input, output, dt)], HALF)
    # A single step does not tell a delay from the ramp of a slew rate.
    assert behind.dynamics == ("mode+delay+slew",)
    assert set(reasons(untried)) == {"arma", "lag"}
    for reason in reasons(untried).values():
        assert reason == "the training part shows a resonance at 60 Hz"
    still = np.where(time > 0.1, input, 0.0) - np.where(time > 0.1, 5.0, 0.0)
    behind, untried = supported_parts([Record(still, 0.1 * still, dt)], HALF)
    assert behind.dynamics == ("lag",)
    assert "arma" in reasons(untried)


def test_a_short_record_excludes_creep():
    found, untried = first_round([RICH], slice(0, 900), OPTIONS)
    assert not any("creep" in model for model in models(found))
    assert "lasts 0.9 s" in reasons(untried)["exponential_creep"]


def test_later_rounds_try_other_creeps_and_simpler_dynamics():
    best = ["coleman_hodgdon+exponential_creep+arma"]
    behind, _ = supported_parts([RICH], HALF)
    assert set(behind.creeps) == {*parts_at("creep"), ""}
    creeps, dynamics = later_rounds([RICH], HALF)
    others = [name for name in behind.creeps if name != "exponential_creep"]
    chains = ["+".join(p for p in ("coleman_hodgdon", c, "arma") if p) for c in others]
    assert models(creeps(best)) == chains
    assert models(dynamics(best)) == ["coleman_hodgdon+exponential_creep+lag"]
    assert models(dynamics(["coleman_hodgdon+arma"])) == ["coleman_hodgdon+lag"]
    for later in later_rounds([ONE], slice(0, 900)):
        assert later(["coleman_hodgdon+lag"]) == []


def test_a_model_with_past_outputs_has_no_further_dynamics():
    for name in OWN_DYNAMICS:
        found, _ = first_round([RICH], HALF, OPTIONS, [name])
        assert f"{name}+exponential_creep" in models(found)
        _, dynamics = later_rounds([RICH], HALF)
        assert dynamics([f"{name}+exponential_creep"]) == []


def test_several_inputs_allow_the_linear_model_only():
    time = np.arange(2000)
    inputs = np.stack([np.sin(0.1 * time), np.cos(0.23 * time)], axis=1)
    record = Record(inputs, inputs @ [[1.0, 0.2], [0.1, 2.0]], 1e-3, period=1000)
    found, untried = first_round([record], HALF, OPTIONS)
    assert ("state_space", "frequency_response") in found
    assert all("2 inputs and 2 outputs" in reasons(untried)[h] for h in HYSTERESIS)
    assert later_rounds([record], HALF) == []


def test_several_records_of_one_stage_are_fitted_together():
    found, untried = first_round([RICH, RICH], HALF, OPTIONS)
    assert "coleman_hodgdon+exponential_creep+arma" in models(found)
    assert "another input" in reasons(untried)["state_space"]
    assert "2 records" in reasons(untried)["hysteretic_arma"]
    assert "preisach+exponential_creep+arma" in models(found)
    assert "preisach" not in reasons(untried)


def test_parts_are_listed_by_place():
    places = [kind.part.place for kind in parts().values()]
    assert list(dict.fromkeys(places)) == list(PLACES)
    assert places == sorted(places, key=PLACES.index)
