"""Retuning of emulated stages under hostile events.

    python tests/benchmarks/hostile.py [--runs FIRST:STOP] [--json FILE]

Every fifth of the 200 retunings has an event in the middle of one of its runs: the
sensor drops out or sticks, the mode of the stage moves by 30 %, the connection breaks,
or one of both processes is killed. The bar, on all of them: the voltage is at most one
sample beyond its limit or its slew limit, the safe gains are set after every event that
stops a run, and every run is in the log.
"""

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np

import piezojax as pj
from piezojax.dynamics import Mode
from piezojax.stages import Fault, LostError, RemoteStage
from piezojax.stages.emulated import EmulatedStage
from piezojax.stages.run_files import load_samples, run_files
from piezojax.tuning import RetuneReport, retune
from piezojax.tuning.attempts import RETUNE_FILE

sys.path.insert(0, str(Path(__file__).parents[1]))

from stages.stage_in_tests import DT, LIMITS, SAFE, STUDY, served, stage, write_study

COUNT, EVERY = 200, 5
EVENTS = "dropout", "stuck", "mode moves", "disconnection", "kill client", "kill stage"
SENSOR = EVENTS[:3]
RUNS = 10
MODE, DAMPING, GAIN = 120.0, 0.05, 0.1
ERRORS = {"dynamics.frequency": 0.1, "dynamics.damping": 1e-4, "calibration.gain": 1e-4}
WAIT = 20.0
"""Longest time until a stage is safe, s."""


def plant(gain=GAIN, mode=MODE):
    return pj.series(dynamics=Mode(mode, DAMPING, DT), calibration=pj.Affine(gain))


class Logged(EmulatedStage):
    """Stage that keeps its voltage at every sample, and calls ``event`` in a run."""

    def __post_init__(self):
        self.voltages, self.retreats, self.begun = [], 0, 0
        self.at, self.event = 0, None
        super().__post_init__()

    def run(self, reference, gains):
        self.begun += 1
        if self.event is not None and self.begun == self.at:
            event, self.event = self.event, None
            event()
        return super().run(reference, gains)

    def _advance(self, reference, codes):
        found = super()._advance(reference, codes)
        self.voltages.append(found.voltage)
        return found

    def _retreat(self):
        super()._retreat()
        self.retreats += 1

    def is_safe(self):
        return self.gains() | SAFE == self.gains()

    def beyond(self):
        """Return the number of samples beyond a limit of the voltage or the slew."""
        whole = np.concatenate([[0.0], *self.voltages])
        outside = (whole < LIMITS.lower - 1e-9) | (whole > LIMITS.upper + 1e-9)
        fast = np.abs(np.diff(whole)) > LIMITS.slew * DT * (1.0 + 1e-9)
        return int(np.sum(outside) + np.sum(fast))


def logged(random, number, **changed):
    gain, mode = 1.0 + random.uniform(-0.2, 0.2, 2)
    built = stage(plant=plant(gain * GAIN, mode * MODE), seed=number, **changed)
    kept = {name: getattr(built, name) for name in built.__dataclass_fields__}
    return Logged(**kept), gain * GAIN, mode * MODE


def lost_in_log(folder, begun):
    """Return what is missing in the log of a retuning that began so many runs."""
    report = RetuneReport.model_validate_json((folder / RETUNE_FILE).read_text())
    files = run_files(folder)
    missing = [run.file for run in report.runs if not (folder / run.file).is_file()]
    for file in files:
        load_samples(file)
    # The last run of a killed process has not ended.
    if missing or begun - len(report.runs) not in (0, 1):
        return f"{begun} runs begun, {len(report.runs)} in the log, missing {missing}"
    return ""


def wait_until(found):
    end = time.monotonic() + WAIT
    while time.monotonic() < end:
        if found():
            return True
        time.sleep(0.02)
    return False


def inside(study, one, folder):
    """Retune in this process; a connection that is lost ends it."""
    try:
        return retune(study, one, folder, runs=RUNS).verdict
    except LostError:
        return "lost"


def sensor_event(random, event, one, gain, mode):
    """Let a fault of the sensor or the plant begin in one of the first runs."""

    def happen():
        begin = int(random.integers(300, 1000))
        if event == "mode moves":
            factor = random.choice([0.7, 1.3])
            one.faults = [Fault("plant", begin, 1, plant(gain, factor * mode))]
        else:
            one.faults = [Fault(event, begin, 400)]

    return happen


def with_fault(random, number, event, study, folder):
    one, gain, mode = logged(random, number)
    if event:
        one.at = int(random.integers(1, 3))
        one.event = sensor_event(random, event, one, gain, mode)
    verdict = inside(study, one, folder)
    report = RetuneReport.model_validate_json((folder / RETUNE_FILE).read_text())
    stopped = sum(bool(run.stopped) for run in report.runs)
    problems = []
    if one.retreats < stopped:
        problems.append(f"{stopped} stops, {one.retreats} retreats to the safe gains")
    final = SAFE if report.best is None else report.attempts[report.best].gains
    if verdict != "done":
        final = SAFE
    set_now = one.gains()
    if not all(math.isclose(set_now[path], final[path]) for path in final):
        problems.append("the gains at the end are neither the best nor the safe ones")
    if report.best is not None and report.best_error > report.attempts[0].error:
        problems.append("the error at the end is above that at the beginning")
    return one, verdict, problems, one.begun


def with_disconnection(random, number, event, study, folder):
    del event
    one, *_ = logged(random, number, speed=0.3)
    with served(one) as address:
        remote = RemoteStage(address)
        one.at = int(random.integers(1, 3))
        delay = random.uniform(0.05, 0.4)
        one.event = lambda: threading.Timer(delay, remote.abandon).start()
        verdict = inside(study, remote, folder)
        problems = [] if wait_until(one.is_safe) else ["the stage is not safe"]
    return one, verdict, problems, one.begun


def with_killed_client(random, number, event, study, folder):
    del event
    one, *_ = logged(random, number, speed=0.3)
    with served(one) as address:
        command = [sys.executable, "-m", "piezojax.retune", study, "--stage", address]
        command = [*map(str, command), "--out", str(folder), "--quiet"]
        client = subprocess.Popen(command)
        one.at = int(random.integers(1, 3))
        delay = random.uniform(0.05, 0.4)
        one.event = lambda: threading.Timer(delay, client.kill).start()
        verdict = client.wait()
        problems = [] if wait_until(one.is_safe) else ["the stage is not safe"]
    if verdict != -signal.SIGKILL:
        problems.append(f"the client ended with {verdict}")
    return one, "killed", problems, one.begun


def with_killed_stage(random, number, event, study, folder):
    del event
    command = [sys.executable, "-m", "piezojax.emulate", study, "--quiet"]
    options = ["--speed", "0.3", "--seed", str(number)]
    emulated = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)
    try:
        address = emulated.stdout.readline().removeprefix("stage at ").strip()
        remote, begun, at = RemoteStage(address), 0, int(random.integers(1, 3))
        whole = remote.run

        def run(reference, gains):
            nonlocal begun
            begun += 1
            if begun == at:
                threading.Timer(random.uniform(0.05, 0.4), emulated.kill).start()
            return whole(reference, gains)

        remote.run = run
        verdict = inside(study, remote, folder)
        remote.abandon()
        problems = [] if verdict == "lost" else [f"the verdict is {verdict}"]
    finally:
        emulated.kill()
        emulated.wait()
    return None, verdict, problems, begun


KINDS = {
    "disconnection": with_disconnection,
    "kill client": with_killed_client,
    "kill stage": with_killed_stage,
}


def judged(number, study, folder):
    """Retune stage ``number``; return its event, verdict and problems."""
    random = np.random.default_rng([22, number])
    event = EVENTS[number // EVERY % len(EVENTS)] if number % EVERY == 0 else ""
    out = folder / f"out_{number}"
    out.mkdir()
    kind = KINDS.get(event, with_fault)
    one, verdict, problems, begun = kind(random, number, event, study, out)
    if one is not None and one.beyond() > 1:
        problems.append(f"{one.beyond()} samples beyond the limits")
    lost = lost_in_log(out, begun)
    problems += [lost] if lost else []
    return event or "none", verdict, problems


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", default=f"0:{COUNT}", metavar="FIRST:STOP")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    first, stop = map(int, chosen.runs.split(":"))
    rows, counts = [], Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "programs"))
        slow = STUDY["controller"] | {"proportional": 0.2, "integral": 500.0}
        study = write_study(folder, plant(), ERRORS, controller=slow)
        for number in range(first, stop):
            event, verdict, problems = judged(number, study, folder)
            rows.append((number, event, verdict, problems))
            counts[event, verdict] += 1
            print(
                f"{number:3} {event:14} {verdict:8} {'; '.join(problems)}", flush=True
            )
            if chosen.json:
                chosen.json.write_text(json.dumps(rows))
    for (event, verdict), count in sorted(counts.items()):
        print(f"{event:14} {verdict:8} {count:4}")
    bad = sum(bool(problems) for *_, problems in rows)
    print(f"{len(rows) - bad} of {len(rows)} without a problem")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
