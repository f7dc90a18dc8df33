"""Commands killed at random moments: finished results remain, temporary files do not.

    python tests/benchmarks/kills.py [--kills N] [--first N] [--seed N]

Each kill starts tune, identify --model all or a sweep, and sends SIGTERM or SIGKILL
after a random time. There must be no traceback, the right exit status, and every
finished fit and chunk; after the next run there must be no temporary files and no empty
folders. Exits with 1 if a kill shows a fault.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import tomli_w

import piezojax as pj
from piezojax.core.files import numbered_folder

STUDY = {
    "title": "a PID on a lag",
    "rate": 20_000.0,
    "plant": {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.012},
    "controller": {"catalog": "p753_pid"},
    "references": {"tune": ["SIN50", "SW50"], "duration": 0.05, "settle": 0.02},
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 5.0, "scale": "log"},
        "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"},
    },
    "optimiser": {"starts": 2, "candidates": 4, "steps": 300, "tolerance": 1e-15},
}
SWEEP = {"method": "latin_hypercube", "samples": 4000, "chunk": 64}
LONGEST = {"tune": 15.0, "identify": 25.0, "sweep": 9.0}
"""Time (s) within which a command is killed; it takes about as long."""

GRACE = 60.0
"""Longest time (s) from SIGTERM to the end of a command."""


def prepare(folder: Path) -> dict[str, list[str]]:
    """Write the inputs into ``folder``; return the arguments of each command."""
    (folder / "small.toml").write_text(tomli_w.dumps(STUDY))
    (folder / "swept.toml").write_text(tomli_w.dumps(STUDY | {"sweep": SWEEP}))
    time_s = 1e-3 * np.arange(300)
    drive = 10.0 * (1.0 - np.cos(80.0 * np.pi * time_s)) * (1.0 + (time_s < 0.15))
    moved = 0.12 * np.convolve(drive, 0.5 ** np.arange(1, 12))[: time_s.size] + 4.0
    rows = zip(time_s, drive, moved, strict=True)
    lines = [f"{t:.4f},{u:.6f},{y:.6f}" for t, u, y in rows]
    (folder / "bench.csv").write_text("\n".join(["time_s,u_V,y_um", *lines]))
    columns = ["--time", "time_s", "--input", "u_V", "--output", "y_um"]
    among = ["--model", "all", "--among", "prandtl_ishlinskii,coleman_hodgdon"]
    return {
        "tune": ["small.toml"],
        "identify": ["bench.csv", *columns, *among, "--steps", "5"],
        "sweep": ["swept.toml", "--out", "results/swept"],
    }


def command(name: str, arguments: list[str]) -> list[str]:
    """Return the command line of the command ``name``."""
    return [sys.executable, "-u", "-m", f"piezojax.{name}", *arguments]


def one_kill(number: int, seed: int) -> tuple[str, list[str]]:
    """Return the killed command and its faults."""
    draw = random.Random(1000 * seed + number)
    name = ("tune", "identify", "sweep")[number % 3]
    stop = draw.choice((signal.SIGTERM, signal.SIGKILL))
    wait = draw.uniform(0.3, LONGEST[name])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        arguments = prepare(folder)[name]
        process = subprocess.Popen(
            command(name, arguments),
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            printed, complaint = process.communicate(timeout=wait)
        except subprocess.TimeoutExpired:
            before = stored(folder)
            sent = time.monotonic()
            process.send_signal(stop)
            try:
                printed, complaint = process.communicate(timeout=GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                return f"{name} {stop.name}", [f"goes on for {GRACE:g} s"]
            took = time.monotonic() - sent
            what = f"{name} {stop.name} at {wait:.1f} s, ended {took:.1f} s later"
        else:
            what, before = f"{name} finished in {wait:.1f} s", stored(folder)
        faults = [] if "Traceback" not in complaint else [complaint[-2000:]]
        code = process.returncode
        if code not in (0, -signal.SIGKILL, -signal.SIGTERM, 143):
            faults.append(f"exit status {code}: {complaint[-500:]}")
        what += f", status {code}"
        faults += lost(name, folder, printed, stop, code, before)
        faults += left_over(name, folder, arguments)
    return what, faults


def stored(folder: Path) -> dict[str, int]:
    """Return the finished chunks of a sweep and when they were written."""
    chunks = folder.glob("results/swept/chunks/*.chunk")
    return {path.name: path.stat().st_mtime_ns for path in chunks}


def lost(
    name: str,
    folder: Path,
    printed: str,
    stop: signal.Signals,
    code: int,
    before: dict[str, int],
) -> list[str]:
    """Return finished results that are missing or damaged."""
    out = folder / "results" / {"tune": "small", "identify": "bench"}.get(name, "swept")
    faults = []
    if name == "tune":
        began = "tuning from" in printed
        if began and code == 143 and pj.load_result(out).status != "interrupted":
            faults.append("the result is not marked as interrupted")
        if (out / "result.json").exists():
            pj.load(out / "gains.toml", accept_unsafe=True)
    elif name == "identify":
        begun = dict.fromkeys(
            line.split(":")[0] for line in printed.splitlines() if " of about " in line
        )
        if len(begun) > 1:
            report = json.loads((out / "comparison.json").read_text())
            done = [row for row in report["rows"] if row["status"] != "not tried"]
            if len(done) < len(begun) - 1:
                faults.append(f"{len(done)} of {len(begun) - 1} finished fits are kept")
            for row in done:
                if row["folder"] is not None:
                    pj.load(out / row["folder"] / "model.json", accept_unsafe=True)
    elif not before.items() <= stored(folder).items():
        faults.append("finished chunks are gone")
    return faults


def left_over(name: str, folder: Path, arguments: list[str]) -> list[str]:
    """Start the next run; return the temporary files and empty folders after it."""
    faults = []
    if name == "sweep":
        before = stored(folder)
        again = command(name, [*arguments, "--quiet"])
        done = subprocess.run(again, cwd=folder, check=False)
        after = stored(folder)
        if done.returncode or not (folder / "results/swept/sweep.nc").exists():
            faults.append(f"the next run ends with {done.returncode}")
        if not before.items() <= after.items():
            faults.append("the next run simulates finished chunks again")
    else:
        stem = "small" if name == "tune" else "bench"
        following = numbered_folder(folder / "results" / stem)
        if following.is_dir():
            following.rmdir()  # empty: the next run uses it
    for path in folder.rglob("*"):
        empty = path.is_dir() and not any(path.iterdir())
        if path.name.endswith(".part") or (empty and path != folder / "results"):
            faults.append(f"left over: {path.relative_to(folder)}")
    return faults


def main() -> int:
    """Kill the given number of times; return 1 if a kill shows a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    os.environ.setdefault("PIEZOJAX_COMPILATION_CACHE", tempfile.mkdtemp())
    counts: Counter[bool] = Counter()
    for number in range(options.first, options.first + options.kills):
        what, faults = one_kill(number, options.seed)
        counts[bool(faults)] += 1
        print(f"kill {number}: {what}: {'; '.join(faults) or 'well'}", flush=True)
    print(f"{counts[True]} of {options.kills} kills show a fault")
    return 1 if counts[True] else 0


if __name__ == "__main__":
    sys.exit(main())
