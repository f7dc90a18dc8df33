"""Commands on small studies and records, which run in seconds."""

import importlib

import numpy as np
import tomli_w
from click.testing import CliRunner
from study_tables import PID_ON_LAG

import piezojax as pj

STUDY = PID_ON_LAG | {
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "references": {"tune": ["SIN50", "SW50"], "duration": 0.05, "settle": 0.02},
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 5.0, "scale": "log"},
        "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"},
    },
    "optimiser": {"starts": 2, "candidates": 4, "steps": 5},
}
COLUMNS = ("--time", "time_s", "--input", "drive_V", "--output", "sensor_um")
"""Options that name the columns of ``write_record``."""


def main_of(command):
    return importlib.import_module(f"piezojax.cli.{command}").main


def call(command, *arguments):
    """Run a command; without sliders, which take seconds, unless they are asked for."""
    given = [str(a) for a in arguments]
    if command in ("tune", "start") and "--sliders" not in given:
        given = ["--no-sliders", *given]
    return CliRunner().invoke(main_of(command), given)


def succeeded(result):
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    return result


def write_study(folder, name="small.toml", **tables):
    path = folder / name
    path.write_text(tomli_w.dumps(STUDY | tables), encoding="utf-8")
    return path


def write_record(folder, late=0):
    """Write a record of a lag without hysteresis: 300 samples, two amplitudes.

    The output follows the input ``late`` samples later.
    """
    steps = np.arange(300)
    drive = np.where(steps < 150, 20.0, 10.0) * (1.0 - np.cos(2 * np.pi * steps / 25))
    lagged = np.convolve(drive, 0.5 ** np.arange(1, 12))
    lagged = np.concatenate([np.zeros(late), lagged])[: steps.size]
    path = folder / "bench.csv"
    rows = zip(1e-3 * steps, drive, 0.12 * lagged + 4.0, strict=True)
    path.write_text(
        "time_s,drive_V,sensor_um\n"
        + "".join(f"{t:.4f},{u:.6f},{y:.6f}\n" for t, u, y in rows)
    )
    return path


def write_model(folder, gain=0.06):
    """Write the model of that record, a sample later, without the sensor's zero."""
    system = pj.series(
        dynamics=pj.dynamics.ARMA([0.5], [gain]), calibration=pj.Affine(1.0, 0.0)
    )
    path = folder / "model.json"
    pj.save(system, path, pj.About(record="first.csv", rate_Hz=1e3))
    return path
