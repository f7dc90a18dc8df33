"""The JSON schema of a study, judged by the package jsonschema."""

import copy
import json

import numpy as np
import pytest
from click.testing import CliRunner
from fuzz import corpus
from jsonschema import Draft202012Validator
from study_tables import with_values

from piezojax.cli.tune import main
from piezojax.study import (
    Study,
    build,
    ensemble_table,
    file_tables,
    plant_tables,
    schema,
    stage_tables,
    structure_table,
    study_schema,
    sweep_table,
)

SCHEMA = study_schema()
JUDGE = Draft202012Validator(SCHEMA)
STUDIES = {k: v for k, v in corpus.study_trees().items() if "controllers" not in v}
BASE = STUDIES["p753_dob"]


DEFAULTS = {
    "Actuator": {"delay": 0.0, "computation": 0.0},
    "DisturbanceTable": {"drift_rms": 0.0},
    "EnsembleTable": {
        **{"tune": 0, "margins": 64, "holdout": 50},
        **{"aggregate": "mean", "tail": 0.25},
    },
    "NoiseFile": {"scale": 1.0, "play": "spectrum"},
    "ObjectiveTable": {
        **{"aggregate": "geometric_mean", "coupling_weight": 1.0, "noise_draws": 1},
        **{"effort_weight": 0.0, "slew_weight": 0.0},
    },
    "OptimiserTable": {
        **{"method": "gauss_newton", "starts": 8, "candidates": 64, "steps": 60},
        "tolerance": 1e-4,
    },
    "ParetoTable": {"steps": 30},
    "References": {"amplitude": 5.0, "offset": 0.0, "duration": 1.0, "settle": 0.5},
    "SensorTable": {"delay": 0.0, "noise_rms": 0.0},
    "StructuresTable": {"worth": 0.1},
    "Study": {"seed": 0, "holdout_draws": 1},
    "RecordPlant": {
        **{"model": "auto", "input": 0, "output": 1},
        **{"order": 4, "window": 20, "oversample": 8, "steps": 200},
    },
    "ResponsePlant": {"held": False, "unit": "um/V"},
    "SweepTable": {
        "method": "grid",
        "metrics": ["rms_error", "peak_error", "rms_effort", "saturated"],
    },
    "TrajectoryTable": {"scale": 1.0, "start": 0.0, "offset": 0.0},
}
"""What a study means that leaves a key out."""


def test_the_command_prints_a_schema():
    found = CliRunner().invoke(main, ["--schema"])
    assert found.exit_code == 0
    printed = json.loads(found.output)
    Draft202012Validator.check_schema(printed)
    assert printed == json.loads(json.dumps(SCHEMA))


def test_a_study_that_leaves_a_key_out_keeps_its_meaning():
    found = {}
    for name, table in (*SCHEMA["$defs"].items(), ("Study", SCHEMA)):
        values = {
            key: each["default"]
            for key, each in table["properties"].items()
            if each.get("default") not in (None, []) and "$ref" not in each
        }
        found |= {name: values} if values else {}
    assert found == DEFAULTS


@pytest.mark.parametrize("name", STUDIES)
def test_shipped_studies_are_valid(name):
    JUDGE.validate(STUDIES[name])


@pytest.mark.parametrize(
    "changes",
    [
        {"rate": -1.0},
        {"rates": 1.0},
        {"references/tune": []},
        {"actuator/lowest": 0.0},
        {"optimiser/method": "newton"},
        {"optimiser/steps": 0},
        {"constraints/phase_margin": 180.0},
        {"constraints/sensitivity_peak": 1.0},
        {"constraints/ringing": 1.0},
        {"controller": {"design": "lqr"}},
        {"controller": {"catalog": "p753"}},
        {"plant": {"type": "Affin"}},
        {"plant": {"record": "a.csv", "modle": "auto"}},
        {"plant": {"record": []}},
        {"plant": {"model": "auto"}},
        {"plant": {"response": "a.csv", "held": "yes"}},
        {"sweep": {"metrics": ["rms"]}},
        {"pareto": {"constraint": "speed", "limits": [1.0, 2.0]}},
    ],
)
def test_mistakes_are_found(changes):
    assert not JUDGE.is_valid(with_values(BASE, changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"constraints/phase_margin": 179.0},
        {"constraints/sensitivity_peak": "off"},
        {"controller": {"design": "inversion_pid"}},
        {"controller": {"type": "PID", "proportional": 1.0, "dt": 5e-5}},
        {"controller": {"file": "gains.toml", "accept_unsafe": True}},
        {"plant": {"record": "a.csv", "model": "auto"}},
        {"plant": {"records": ["a.csv", "b.csv"], "check": "c.csv"}},
        {"plant": {"response": "a.csv", "held": True}},
        {"plant": {"type": "FirstOrderLag", "gain": 1.0, "order": "its own"}},
        {"references/amplitude": [1.0, 2.0]},
    ],
)
def test_what_a_study_may_have_is_valid(changes):
    JUDGE.validate(with_values(BASE, changes))


def keys_of(schema):
    """Yield the keys of each table, with the name of the table."""
    for name, table in (*schema["$defs"].items(), ("Study", schema)):
        for key, each in table["properties"].items():
            yield f"{name}.{key}", each
    for name, each in schema["properties"]["constraints"]["properties"].items():
        yield f"constraints.{name}", each


def test_every_key_has_a_description():
    """A key of one table may have the description of that table."""
    keys = dict(keys_of(SCHEMA))
    assert {"Study.rate", "References.tune", "constraints.effort"} < keys.keys()
    keys |= SCHEMA["$defs"]
    bare = [key for key, each in keys.items() if not each.get("description")]
    assert [key for key in bare if "$ref" not in keys[key]] == []


def test_a_description_ends_with_the_unit():
    keys = dict(keys_of(SCHEMA))
    assert keys["Study.rate"]["unit"] == "Hz"
    assert keys["constraints.settling_time"]["unit"] == "s"
    for each in keys.values():
        if "unit" in each:
            assert each["description"].endswith(f". Unit: {each['unit']}.")


@pytest.mark.parametrize("name", [*SCHEMA["$defs"], "Study"])
def test_examples_are_valid(name):
    """The example of each table is read, by pydantic and by the schema."""
    (example,) = SCHEMA["$defs"].get(name, SCHEMA)["examples"]
    table = {"$ref": f"#/$defs/{name}", "$defs": SCHEMA["$defs"]}
    Draft202012Validator(SCHEMA if name == "Study" else table).validate(example)
    tables = (schema, file_tables, plant_tables, stage_tables, sweep_table)
    tables += (ensemble_table, structure_table)
    (kind,) = {vars(each)[name] for each in tables if name in vars(each)}
    kind.model_validate(example)


def test_the_example_of_a_study_is_built():
    case = build(Study.model_validate(SCHEMA["examples"][0]), "example.toml")
    assert case.space.paths


def test_no_study_that_loads_is_marked():
    """Of mutated studies, those that pydantic accepts are valid.

    The sources of plant and controllers are read later.
    """
    random, accepted = np.random.default_rng(21), 0
    for _ in range(300):
        data = corpus.mutated(copy.deepcopy(BASE), random)
        try:
            Study.model_validate(data)
        except ValueError:
            continue
        accepted += 1
        errors = {error.path[0]: error for error in JUDGE.iter_errors(data)}
        assert errors.keys() <= {"plant", "controller", "beside"}, errors
    assert accepted > 30
