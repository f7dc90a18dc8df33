"""Retuning on emulated stages that are not the model.

    python tests/benchmarks/retune.py [--stages FIRST:STOP] [--runs 10] [--json FILE]

A nominal stage with plays and a mode at 800 Hz is recorded, identified and tuned by
``start``. The 30 stages have another class of hysteresis (Bouc-Wen, Coleman-Hodgdon),
a gain and a mode that differ by up to 20 %, and 0 to 2 samples of delay. On each the
tuned gains are improved by ``retune`` in ten runs, small motion included. The bar: in
the median an error at least three times below that of the nominal gains, and never
above it. A start that the guard stops has an infinite error.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import jax
import numpy as np
import tomli_w

import piezojax as pj
from piezojax.core.paths import parameters
from piezojax.dynamics import FractionalDelay, Mode
from piezojax.hysteresis import (
    NormalisedBoucWen,
    PrandtlIshlinskii,
    ShapedColemanHodgdon,
)
from piezojax.identification.estimators.free_runs import free_run
from piezojax.stages.of_study import emulated_stage
from piezojax.tuning import retune

DT = 1e-4
STAGES = 30
REFERENCE = "SCAN20"
MODE, DAMPING, DELAYS = 800.0, 0.02, 2.0
OFF = 0.2
NOISE = 1e-3
"""Rms noise of the sensor, um."""


def plays(gain):
    thresholds = np.linspace(4.0, 45.0, 11)
    weights = gain * np.linspace(0.006, 0.001, 11)
    return PrandtlIshlinskii((0.06 * gain,), tuple(thresholds), tuple(weights))


def bouc_wen(gain):
    return NormalisedBoucWen(0.11 * gain, -0.9 * gain, 0.05, 1.2, 1.5)


def coleman_hodgdon(gain):
    pull = gain * np.array([0.0, 1.7e-3, 5e-6, -3e-8])
    slope = gain * np.array([0.064, 1.6e-4, -1.8e-6])
    return ShapedColemanHodgdon(tuple(pull), tuple(slope), c=-0.022)


OTHERS = {"Bouc-Wen": bouc_wen, "Coleman-Hodgdon": coleman_hodgdon}


def stage_plant(hysteresis, mode=MODE, delay=0.0):
    return pj.series(
        hysteresis=hysteresis,
        dynamics=Mode(mode, DAMPING, DT),
        delay=FractionalDelay(delay * DT, DT, 5),
    )


def record(plant, file):
    """Write 3 s of the nominal stage: a sine of falling amplitude and a chirp."""
    time_s = DT * np.arange(30_000)
    amplitude = np.interp(
        time_s, [0.0, 0.6, 1.2, 1.8, 2.4, 3.0], [0, 50, 50, 30, 15, 15]
    )
    drive = 50.0 + amplitude * np.sin(10.0 * np.pi * time_s - np.pi / 2.0)
    drive[time_s < 0.1] = 500.0 * time_s[time_s < 0.1]
    drive += (
        (time_s > 0.2) * 2.0 * np.sin(2.0 * np.pi * (20.0 + 250.0 * time_s) * time_s)
    )
    output = np.asarray(jax.jit(lambda u: free_run(plant, u, u[0]))(drive))
    output = output + NOISE * np.random.default_rng(0).standard_normal(len(drive))
    columns = np.c_[time_s, drive, output]
    np.savetxt(file, columns, delimiter=",", header="t_s,u_V,y_um", comments="")


def nominal(folder):
    """Return the study of the nominal stage and the tuned gains."""
    record(stage_plant(plays(1.0)), folder / "nominal.csv")
    command = [sys.executable, "-m", "piezojax.start", "nominal.csv", "--yes"]
    options = ["--lower", "-10", "--upper", "120", "--no-sliders", "--out", "nominal"]
    subprocess.run([*command, *options], cwd=folder, check=True, capture_output=True)
    made = tomllib.loads((folder / "nominal" / "study.toml").read_text())
    made["plant"] = {"file": "tuned/model.json"}
    made["references"] |= {"tune": [REFERENCE], "unseen": []}
    study = folder / "nominal" / "retune.toml"
    study.write_text(tomli_w.dumps(made))
    gains = parameters(pj.load(folder / "nominal" / "tuned" / "gains.toml"))
    return study, {path: float(value) for path, value in gains.items()}


def tried(number, study, gains, folder, runs):
    """Return the row of a stage: how it differs, and its errors in nm."""
    random = np.random.default_rng([22, number])
    name = list(OTHERS)[number % len(OTHERS)]
    gain, mode = 1.0 + random.uniform(-OFF, OFF, 2)
    delay = random.uniform(0.0, DELAYS)
    plant = folder / f"stage_{number}.json"
    pj.save(stage_plant(OTHERS[name](gain), mode * MODE, delay), plant)
    stage = emulated_stage(study, plant=plant, speed=0.0, seed=number)
    stage.apply(gains)
    out = folder / f"out_{number}"
    out.mkdir()
    begun = time.process_time()
    report = retune(study, stage, out, runs=runs)
    return {
        "stage": number,
        "class": name,
        "gain": gain,
        "mode": mode,
        "delay": delay,
        "start_nm": 1e3 * report.attempts[0].error,
        "end_nm": 1e3 * report.best_error,
        "ratio": report.ratio,
        "attempts": [attempt.verdict for attempt in report.attempts],
        "runs": len(report.runs),
        "verdict": report.verdict,
        "notes": report.notes,
        "alarms": report.alarms,
        "cpu_s": time.process_time() - begun,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stages", default=f"0:{STAGES}", metavar="FIRST:STOP")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    first, stop = map(int, chosen.stages.split(":"))
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study, gains = nominal(folder)
        for number in range(first, stop):
            rows.append(row := tried(number, study, gains, folder, chosen.runs))
            print(
                f"{row['stage']:2} {row['class']:15} gain {row['gain']:.2f} mode "
                f"{row['mode']:.2f} delay {row['delay']:.1f}: {row['start_nm']:.4g} to "
                f"{row['end_nm']:.4g} nm, {row['ratio']:.3g} times smaller, "
                f"{row['runs']} runs, {row['verdict']}; {', '.join(row['attempts'])}",
                *row["alarms"],
                *row["notes"],
                sep="\n   ",
                flush=True,
            )
            if chosen.json:
                chosen.json.write_text(json.dumps(rows, indent=2))
    ratios = np.array([row["ratio"] for row in rows])
    print(f"{len(rows)} stages: {np.median(ratios):.3g} times smaller in the median")
    print(f"{np.sum(ratios < 1.0)} end above the start")
    print(f"{np.sum(~np.isfinite(ratios))} starts were stopped by the guard")


if __name__ == "__main__":
    main()
