"""Throughput, memory and cost of a sweep, against a prediction from one core.

    python tests/benchmarks/sweep.py --json sweep.json [--samples 10000] [--kills 20]

The sweep is 10 000 gain sets of the DOB-based PID-SMC on the P-753 x the ten references
of the thesis x 1 s at 20 kHz: 2e9 samples. It runs in a separate process, like the
command. Figures of the JSON file:

    lane_steps             simulated samples
    block_s                median time of blocks of 64 lanes of tests/benchmarks/
                           throughput.py (one core, signals time first), before and
                           after the sweep, half of them each
    predicted_s            lane_steps at that speed, divided by the cores
    simulating_s, ratio    time from the first chunk to the last, over predicted_s
    cpu_ratio              processor time of a sample over that of such a block, which
                           depends less on other load (Linux)
    wall_s, wall_ratio     the whole command, Python's start and compiling included
    lane_steps_per_s       lane_steps / simulating_s, all cores together
    rss_mb                 resident memory over time, [s since the first chunk,
                           MB (10^6)], while chunks are simulated; rss_growth is
                           the largest in its last half over the largest in its first
    rss_peak_mb            largest of the whole command, pictures included
    cost                   core-hours of 10^9 simulations at the measured chunk times
    kills                  with --kills N: a smaller sweep killed N times at random
                           moments, and whether it then equals the uninterrupted one
"""

import argparse
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import engines
import numpy as np
import tomli_w

from piezojax.signals import waveforms as signals
from piezojax.study import load, shipped

RATE, BLOCK = 20_000, 64
COMMAND = (sys.executable, "-m", "piezojax.sweep")


def parse(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0, help="of the moments of kills")
    return parser.parse_args(arguments)


def cores():
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def write_study(path, samples, **sweep):
    """Write the shipped study of this controller with eight gains drawn by Sobol.

    The stage is that of throughput.py, without creep and mode.
    """
    study = load(shipped("p753_dob")).model_dump(mode="json", exclude_none=True)
    study["plant"], study["disturbance"] = {"catalog": "p753"}, {}
    study["references"] |= {"tune": list(signals.THESIS), "unseen": []}
    study["sweep"] = {"method": "sobol", "samples": samples, **sweep}
    path.write_text(tomli_w.dumps(study))
    return path


def block_seconds(repeats):
    """Return wall and processor times of blocks of the throughput benchmark."""
    from piezojax_engine import PiezojaxEngine

    engine = PiezojaxEngine()
    engine.prepare(*engines.DOB_PID_SMC.problem(BLOCK, RATE))
    engine.run()
    found = []
    for _ in range(repeats):
        begin = time.perf_counter(), time.process_time()
        engine.run()
        found.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
    return found


def state_of(process):
    """Return the resident memory (MB) and the processor time (s) of a process."""
    folder = Path(f"/proc/{process.pid}")
    try:
        pages = int((folder / "statm").read_text().split()[1])
        ticks = (folder / "stat").read_text().rpartition(")")[2].split()[11:13]
    except (OSError, IndexError):
        return None
    memory = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return memory, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def run_command(study, out, every_s=0.05):
    """Run and observe the sweep; return seconds, and [time, MB, s of processor]."""
    begin = time.perf_counter()
    process = subprocess.Popen([*COMMAND, study, "--out", out, "--quiet"])
    watched = []
    while process.poll() is None:
        state = state_of(process)
        if state and state[0] > 0.0:
            watched.append((time.time(), *state))
        time.sleep(every_s)
    if process.returncode:
        raise SystemExit(f"the sweep ended with status {process.returncode}")
    return time.perf_counter() - begin, watched


def chunks_of(out):
    """Return the time of each chunk (s) and its core time (s), in order of time."""
    found = []
    for path in (out / "chunks").glob("*.chunk"):
        with open(path, "rb") as file:
            file.readline()
            header = json.loads(file.readline())
        found.append((path.stat().st_mtime, header["seconds"]))
    return sorted(found)


def simulating_seconds(chunks, workers):
    """Return the time from the start of the first chunk to the end of the last."""
    first = min(end - seconds for end, seconds in chunks[: 2 * workers])
    return chunks[-1][0] - first


def in_core_hours(seconds):
    return seconds / 3600.0


def main_sweep(folder, samples):
    workers, references = cores(), len(signals.THESIS)
    blocks = block_seconds(10)
    study = write_study(folder / "bar.toml", samples)
    wall, watched = run_command(study, folder / "bar")
    blocks += block_seconds(10)
    block, block_cpu = (
        statistics.median(column) for column in zip(*blocks, strict=True)
    )
    steps = samples * references * RATE
    predicted = steps / (BLOCK * RATE) * block / workers
    chunks = chunks_of(folder / "bar")
    simulating = simulating_seconds(chunks, workers)
    first, last = chunks[0][0], chunks[-1][0]
    during = [row for row in watched if first <= row[0] <= last]
    memory, half = [row[1] for row in during], len(during) // 2
    # processor time between the first and the last observation
    share = (during[-1][0] - during[0][0]) / simulating
    cpu_each = (during[-1][2] - during[0][2]) / (share * steps)
    core_s = sum(seconds for _, seconds in chunks)
    each = core_s / (samples * references)
    return {
        "simulations": samples * references,
        "lane_steps": steps,
        "cores": workers,
        "block_s": block,
        "block_ns_per_lane_step": 1e9 * block / (BLOCK * RATE),
        "block_cpu_ns_per_lane_step": 1e9 * block_cpu / (BLOCK * RATE),
        "predicted_s": predicted,
        "simulating_s": simulating,
        "ratio": simulating / predicted,
        "cpu_ns_per_lane_step": 1e9 * cpu_each,
        "cpu_ratio": cpu_each / (block_cpu / (BLOCK * RATE)),
        "load_average": os.getloadavg()[0],
        "wall_s": wall,
        "wall_ratio": wall / predicted,
        "lane_steps_per_s": steps / simulating,
        "chunks": len(chunks),
        "rss_mb": [[round(t - first, 2), round(mb, 1)] for t, mb, _ in during],
        "rss_peak_mb": max(mb for _, mb, _ in watched),
        "rss_growth": max(memory[half:]) / max(memory[:half]),
        "cost": {
            "core_s_per_simulation": each,
            "core_hours_of_1e9": in_core_hours(1e9 * each),
            "hours_of_1e9_on_1000_cores": in_core_hours(1e9 * each) / 1000.0,
        },
    }


def killed_sweep(folder, kills, seed):
    """Kill a sweep repeatedly; compare it with an uninterrupted one."""
    import xarray as xr

    draw = random.Random(seed)
    # with small chunks, several per kill
    samples = BLOCK * max(40, 6 * kills)
    study = write_study(
        folder / "small.toml", samples, chunk=BLOCK, references=["SW30"]
    )
    run_command(study, folder / "whole")
    out, died, lost = folder / "killed", [], 0
    before = set()
    for _ in range(kills):
        process = subprocess.Popen([*COMMAND, study, "--out", out, "--quiet"])
        wanted = len(before) + draw.randint(1, 6)
        # Some end before their first chunk, most during a chunk.
        early = draw.random() < 0.2
        give_up = time.monotonic() + draw.uniform(0.5, 4.0)
        while process.poll() is None:
            now = set((out / "chunks").glob("*.chunk")) if out.exists() else set()
            if len(now) >= wanted or (early and time.monotonic() > give_up):
                break
            time.sleep(0.001)
        time.sleep(0.02 * draw.random())
        process.send_signal(signal.SIGKILL)
        process.wait()
        now = set((out / "chunks").glob("*.chunk")) if out.exists() else set()
        lost += len(before - now)
        died.append(len(now))
        before = now
    run_command(study, out)
    with (
        xr.open_dataset(folder / "whole" / "sweep.nc", engine="h5netcdf") as whole,
        xr.open_dataset(out / "sweep.nc", engine="h5netcdf") as found,
    ):
        same = whole.identical(found) and all(
            np.asarray(whole[name]).tobytes() == np.asarray(found[name]).tobytes()
            for name in ("rms_error", "peak_error", "rms_effort", "saturated")
        )
    return {
        "kills": kills,
        "chunks": samples // BLOCK,
        "chunks_kept_at_each_kill": died,
        "chunks_lost": lost,
        "same_bits_as_unbroken": bool(same),
    }


def main(arguments=None):
    options = parse(arguments)
    with tempfile.TemporaryDirectory() as name:
        result = main_sweep(Path(name), options.samples)
        if options.kills:
            result["kills"] = killed_sweep(Path(name), options.kills, options.seed)
    options.json.write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps({k: v for k, v in result.items() if k != "rss_mb"}, indent=2))
    cost = result["cost"]
    print(
        f"10^9 simulations: {cost['core_hours_of_1e9']:.0f} core-hours, "
        f"{cost['hours_of_1e9_on_1000_cores']:.2f} h on 1000 cores"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
