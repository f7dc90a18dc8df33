"""The hysteresis models of hysteresis.c give the same results in C and in piezojax.

A model without a function in C is not a failure.
"""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

# The benchmark is a script with modules beside it, not a package.
sys.path.insert(0, str(Path(__file__).parent))
engines = importlib.import_module("engines")
hysteresis = importlib.import_module("hysteresis")

LANES, STEPS = 20, 2000  # more than one block, the last half filled


def c_engine(problem, what):
    try:
        return hysteresis.CEngine(problem, what)
    except engines.UnavailableError as reason:
        if "gcc is not" in str(reason):
            pytest.skip(str(reason))
        raise


IN_C = [name for name in hysteresis.MODELS if hysteresis.has_c_reference(name)]


def test_the_first_models_have_a_reference_in_c():
    assert {"coleman_hodgdon", *hysteresis.OTHERS} <= set(IN_C)


@pytest.mark.parametrize("name", IN_C)
def test_each_model_equals_c(name):
    problem = hysteresis.Problem(name, LANES, STEPS)
    c = c_engine(problem, "forward").run()
    run = hysteresis.PiezojaxEngine(problem, "run").run()
    assert np.all(c > 0.0)
    np.testing.assert_allclose(run, c, rtol=1e-9)


# One C macro makes all gradients of the functions in the previous test.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["coleman_hodgdon", "bashash_jalili", "duhem"])
def test_gradients_equal_c(name):
    problem = hysteresis.Problem(name, LANES, STEPS)
    differences = c_engine(problem, "gradient").run()
    mode = hysteresis.modes("gradient", len(problem.sizes))[0]
    gradient = hysteresis.PiezojaxEngine(problem, mode).run()
    # relative to the usual change of a parameter, for one-sided differences
    scale = np.max(np.abs(gradient * problem.sizes), axis=1, keepdims=True)
    np.testing.assert_allclose(
        gradient * problem.sizes / scale, differences * problem.sizes / scale, atol=1e-4
    )


def test_the_command_writes_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(hysteresis.throughput, "pin_to_one_core", lambda: 1)
    file = tmp_path / "out.json"
    name = "coleman_hodgdon"
    arguments = ["--models", name, "--lanes", "16", "--steps", "300", "--repeats", "1"]
    assert hysteresis.main(["--json", str(file), *arguments]) == 0
    rows = json.loads(file.read_text())["rows"]
    found = [(row["what"], row["engine"], row["mode"]) for row in rows]
    if ("forward", "c", "run") not in found:
        pytest.skip("no C reference here")
    assert ("forward", "piezojax", "run") in found
    assert ("gradient", "piezojax", "reverse") in found
    assert ("gradient", "c", "differences") in found
    assert {row["bar"] for row in rows} == {2.0}
    assert set(hysteresis.within(rows)) == {(name, "forward"), (name, "gradient")}


def test_models_without_a_function_in_c_are_listed(monkeypatch):
    problem = hysteresis.Problem("coleman_hodgdon", 2, 10)
    problem.name = "unwritten"
    with pytest.raises(engines.UnavailableError, match="has no unwritten"):
        c_engine(problem, "forward")


def test_a_model_without_a_reference_in_c_is_listed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(hysteresis.throughput, "pin_to_one_core", lambda: 1)
    monkeypatch.setattr(hysteresis, "has_c_reference", lambda name: False)
    arguments = ["--json", str(tmp_path / "out.json"), "--models", "duhem"]
    assert hysteresis.main(arguments) == 1  # the only model in this run
    assert "duhem: no reference in C" in capsys.readouterr().out
