"""Test of the recipes of CONTRIBUTING.md, copied into a package outside piezojax."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest

PAGE = Path(__file__).parents[1] / "CONTRIBUTING.md"
FILE = re.compile(r"^`(\w+\.py)`:\n\n```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
TABLE = re.compile(r"^```toml\n(.*?)^```", re.MULTILINE | re.DOTALL)

STUDY = """
title = "a stage of another package"
rate = 10_000.0

[plant]
catalog = "my_stage"

[actuator]
lower = -20.0
upper = 120.0

[sensor]
noise_rms = 0.002

{controller}
[references]
tune = ["SIN10"]
amplitude = 2.0
duration = 0.2
settle = 0.1

[parameters]
"controller.gain" = {{ lower = 1.0, upper = 200.0 }}

[ensemble]
tune = 1
margins = 1
holdout = 1
spread = {{ gain = 0.1 }}

[constraints]
rms_slew = {limit}

[optimiser]
starts = 1
candidates = 4
steps = 2
"""


@pytest.fixture(scope="module")
def page():
    text = PAGE.read_text(encoding="utf-8")
    tables = [tomllib.loads(table) for table in TABLE.findall(text)]
    return dict(FILE.findall(text)), tables


@pytest.fixture(scope="module")
def lab(page, tmp_path_factory):
    """Install the package that the page describes: its modules and entry points."""
    files, tables = page
    folder = tmp_path_factory.mktemp("site")
    (folder / "my_lab").mkdir()
    (folder / "my_lab" / "__init__.py").touch()
    for name, code in files.items():
        (folder / "my_lab" / name).write_text(code)
    (project,) = (table["project"] for table in tables if "project" in table)
    metadata = folder / f"my_lab-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Name: {project['name']}\nVersion: 0.1\n")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{key} = {value}" for key, value in points.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


def python(lab, *arguments, cwd):
    paths = [str(lab), os.environ.get("PYTHONPATH", ""), *sys.path]
    search = os.pathsep.join(filter(None, paths))
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": search, "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


SCRIPT = """
import numpy as np, jax, piezojax as pj
from my_lab.dahl import Dahl
model = Dahl(0.1, 0.2, 0.2)
plant = pj.series(hysteresis=model, lag=pj.dynamics.FirstOrderLag(2e-3, 1e-3))
time = np.arange(3000) * 1e-3
swing = 25 * (1 - np.cos(2 * np.pi * 1.7 * time))
voltage = swing + 25 * (1 - np.cos(2 * np.pi * 0.4 * time))
_, output = pj.simulate(plant, voltage, plant.init(voltage[0]))
noise = 0.005 * np.random.default_rng(0).standard_normal(time.size)
np.savez("record.npz", time=time, input=voltage, output=np.asarray(output) + noise)
pj.save(model, "dahl.json")
inverse = pj.load("dahl.json").inverse(0.0, 120.0)
_, wanted = pj.simulate(model, voltage, model.init(voltage[0]))
_, found = pj.simulate(inverse, wanted, inverse.init(wanted[0]))
print(float(np.max(np.abs(found[1:] - voltage[1:]))))
"""

ENDED = "-- ended with status"
IN_TURN = f"""
import importlib, json, sys
main = importlib.import_module("piezojax.cli." + sys.argv[1]).main
for line in json.loads(sys.argv[2]):
    try:
        main(line)
    except SystemExit as ended:
        print("{ENDED}", ended.code)
"""


def in_turn(lab, command, *lines, cwd):
    """Run a command with each of ``lines`` in one process, to import only once.

    Return the process, and the output and exit status of each run.
    """
    done = python(lab, "-c", IN_TURN, command, json.dumps(lines), cwd=cwd)
    assert done.returncode == 0, done.stderr
    parts = re.split(rf"^{ENDED} (\d+)\n", done.stdout, flags=re.MULTILINE)
    assert len(parts) == 2 * len(lines) + 1
    return done, parts[:-1:2], [int(status) for status in parts[1::2]]


def test_the_page_has_every_recipe(page):
    assert set(page[0]) == {"dahl.py", "lead_lag.py", "rms_slew.py", "my_stage.py"}


def test_a_model_is_saved_inverted_listed_fitted_tried_and_drawn(lab, tmp_path):
    done = python(lab, "-c", SCRIPT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 1e-6

    columns = ("--time", "time", "--input", "input", "--output", "output")
    record = ("record.npz", *columns, "--train", "0:2000", "--validate", "2000:3000")
    lines = (
        ("--model", "help"),
        (*record, "--model", "dahl+lag", "--out", "fit"),
        (*record, "--model", "all", "--among", "dahl", "--out", "all"),
    )
    done, (listed, _, tried), statuses = in_turn(lab, "identify", *lines, cwd=tmp_path)
    assert statuses == [0, 0, 0], done.stderr
    assert "Dahl: a line minus a bounded part" in listed
    report = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert report["validation"]["rmse"] < 0.006
    for name, true in (("slope", 0.1), ("height", 0.2), ("rate", 0.2)):
        found = report["parameters"][f"hysteresis.{name}"]
        assert abs(found["value"] - true) < 5.0 * found["standard_error"]
    assert (tmp_path / "fit" / "fit.png").stat().st_size > 10_000
    assert "dahl" in tried


def study(page, limit):
    (table,) = (table for table in page[1] if "controller" in table)
    keys = [
        f"{key} = {json.dumps(value)}" for key, value in table["controller"].items()
    ]
    return STUDY.format(controller="\n".join(["[controller]", *keys, ""]), limit=limit)


def test_a_study_uses_the_controller_the_constraint_and_the_stage(page, lab, tmp_path):
    (tmp_path / "study.toml").write_text(study(page, 1e6))
    (tmp_path / "wrong.toml").write_text(study(page, -1.0))
    lines = [(f"{name}.toml", "--out", name) for name in ("study", "wrong")]
    done, _, statuses = in_turn(lab, "tune", *lines, cwd=tmp_path)
    assert statuses == [0, 1], done.stderr
    assert "rms_slew is -1.0; it must be a number above 0" in done.stderr
    result = json.loads((tmp_path / "study" / "result.json").read_text())
    assert set(result["gains"]) == {"controller.gain"}
    kept = result["constraints"]["rms_slew"]
    assert kept["unit"] == "V/s"
    assert 0.0 < kept["value"] < kept["limit"]
    assert result["perturbed"]["plants"] == 1
    gains = tomllib.loads((tmp_path / "study" / "gains.toml").read_text())
    assert gains["type"] == "LeadLag"


def test_the_lead_lag_equals_the_bilinear_transform_of_scipy(
    page, tmp_path, monkeypatch
):
    from scipy import signal

    import piezojax as pj

    (tmp_path / "page_lead_lag.py").write_text(page[0]["lead_lag.py"])
    monkeypatch.syspath_prepend(tmp_path)
    from page_lead_lag import LeadLag  # pyright: ignore[reportMissingImports]

    gain, zero, pole, dt = 2.0, 300.0, 20.0, 1e-4
    error = np.random.default_rng(1).standard_normal(200)
    numbers = signal.bilinear([gain, gain * zero], [1.0, pole], 1.0 / dt)
    rest = np.zeros(200)
    controller = LeadLag(gain, zero, pole, dt)
    seen = pj.Observation(*map(jax.numpy.asarray, (error, rest, rest, rest)))
    start = controller.init(pj.Observation(0.0, 0.0, 0.0, 0.0))
    _, found = pj.simulate(controller, seen, start)
    np.testing.assert_allclose(found, signal.lfilter(*numbers, error), atol=1e-12)
