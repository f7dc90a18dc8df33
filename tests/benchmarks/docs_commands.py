"""Run every command that a page of the documentation shows.

    python tests/benchmarks/docs_commands.py [--pages NAME,NAME] [--list] [--json FILE]

The commands in the ``sh`` blocks of README.md, CONTRIBUTING.md and docs/ run page by
page, in their order, in a new folder: a git checkout if a command names a file of the
repository, otherwise a folder without one. INPUTS makes the files that a page expects
of its reader, from simulated stages. SPECIAL has the commands that are skipped, run
with a smaller budget, or end with another status than 0. Prints a table, and exits
with 1 if a command does not end as its page says. Needs a C compiler and ``pip install
-e '.[test,mutation]'``.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from rich.console import Console
from rich.table import Table
from rich.text import Text

import piezojax as pj
from piezojax.signals.excitation import Generator, excitation

sys.path.insert(0, str(Path(__file__).parents[1]))

from shown_commands import DOCS, OWN_FILE, PAGES, ROOT, blocks_in, scripts_in
from stages.stage_in_tests import write_study

LONGEST = 7200.0
"""Time after which a command is stopped, s."""


class Special(NamedTuple):
    """A command that does not simply run as shown and end with status 0.

    ``note`` is the reason. ``run`` is the command that runs, None if none does;
    ``study`` and ``tables`` are a study and the values that replace those in its
    tables; ``statuses`` are those that the page leads its reader to expect, and
    ``typed`` is the input.
    """

    note: str
    run: str | None = ""
    study: str = ""
    tables: dict[str, Any] = {}  # noqa: RUF012
    statuses: tuple[int, ...] = (0,)
    typed: str | None = None


BRIEF = {"starts": 1, "candidates": 4, "steps": 2}
FEW = {"margins": 16, "holdout": 8}
ALARMS = 0, 3
"""Statuses of a search that is too short for its limits."""

ON_STAGE = (
    "python -m piezojax.emulate study.toml --port 5025 --speed 0 > stage.log & "
    "stage=$!; until grep -q 'stage at' stage.log; do sleep 1; done; "
    "{}; status=$?; kill $stage; exit $status"
)
"""A command with the stage of the page behind it."""

TRIED = "python -m piezojax.{} results/study --stage 127.0.0.1:5025{}"
RETUNED = "python -m piezojax.retune study.toml --stage 127.0.0.1:5025 --runs 10"

SPECIAL = {
    "pip install . && python -m piezojax.tune": Special("run by CI", None),
    "pip install '.[test]' && pytest": Special("run by CI", None),
    "pip install -e '.[test]'": Special("run by CI", None),
    "pip install -e '.[test,mutation]'": Special("installed before", None),
    "pytest": Special("run by CI", None),
    "zensical serve": Special(
        "runs until it is stopped", "timeout 20 zensical serve", statuses=(124,)
    ),
    "python -m piezojax.tune tuning/micromanipulator.toml": Special(
        "the page names the alarm", statuses=(3,)
    ),
    "python -m piezojax.start record.csv": Special(
        "Enter at each question", typed="\n" * 20
    ),
    "python -m piezojax.start record.csv --controller nv200 --scale 9.3": Special(
        "Enter at each question", typed="\n" * 20
    ),
    "srun python -m piezojax.sweep study.toml --out /shared/map "
    "--shard $SLURM_ARRAY_TASK_ID/100 --quiet": Special(
        "without SLURM",
        "python -m piezojax.sweep study.toml --out shared/map --shard 1/100 --quiet",
    ),
    "python -m piezojax.tune tuning/comparison/p753.toml": Special(
        "shortened: 32 searches",
        study="tuning/comparison/p753.toml",
        tables={"rates": [20_000.0], "optimiser": BRIEF},
        statuses=ALARMS,
    ),
    "python -m piezojax.tune tuning/comparison/p753_fair.toml": Special(
        "shortened: 7 searches on 1024 plants",
        study="tuning/comparison/p753_fair.toml",
        tables={"optimiser": BRIEF, "ensemble": FEW},
        statuses=ALARMS,
    ),
    **{
        f"python -m piezojax.tune tuning/p753_robust.toml {option}": Special(
            "shortened: 9 minutes on an idle core",
            study="tuning/p753_robust.toml",
            tables={"optimiser": BRIEF, "ensemble": FEW},
            statuses=ALARMS,
        )
        for option in ("--out DIR", "--profile")
    },
    **{
        f"python -m piezojax.tune tuning/three_dof_{name}.toml": Special(
            "shortened: 8 minutes and more on an idle core",
            study=f"tuning/three_dof_{name}.toml",
            tables={"optimiser": BRIEF, "ensemble": {"tune": 1, "holdout": 4}},
            statuses=ALARMS,
        )
        for name in ("sliding_mode", "disturbance_observer")
    },
    **{
        command: Special("with an emulated stage", ON_STAGE.format(command))
        for command in (
            TRIED.format("trial", ""),
            TRIED.format("learn", ""),
            TRIED.format("watch", " --out baseline"),
            TRIED.format("watch", " --baseline baseline"),
        )
    },
    RETUNED: Special("with an emulated stage", ON_STAGE.format(RETUNED)),
    "python -m piezojax.emulate study.toml --port 5025 --gain 1.2 --delay 1": Special(
        "runs until it is stopped",
        "timeout 60 python -m piezojax.emulate study.toml --port 5025 --gain 1.2 "
        "--delay 1",
        statuses=(124,),
    ),
    "python tests/benchmarks/structures.py --seed 23": Special(
        "shortened: 30 stages",
        "python tests/benchmarks/structures.py --seed 23 --plants 0:1",
    ),
    "python tests/mutations/sample.py --modules tuning/alarms.py --count 30 "
    "--seed 18 --json scores.json": Special(
        "shortened: 30 runs of tests",
        "python tests/mutations/sample.py --modules tuning/alarms.py --count 2 "
        "--seed 18 --json scores.json",
    ),
}


class Done(NamedTuple):
    """A command of a page, its outcome, the seconds, and the end of its output."""

    page: str
    command: str
    outcome: str
    seconds: float = 0.0
    note: str = ""
    output: str = ""


# Inputs of the pages


def stage(rate):
    """Return a stage of 0.1 um/V with modes at 740 and 1900 Hz, 100 us late."""
    dt = 1.0 / rate
    return pj.series(
        hysteresis=pj.hysteresis.PrandtlIshlinskii((0.1,), (5.0, 20.0), (0.02, 0.01)),
        modes=pj.dynamics.Modes((740.0, 1900.0), (0.02, 0.03), dt, (0.2,)),
        delay=pj.dynamics.FractionalDelay(1e-4, dt, 2),
    )


def write_columns(path, **columns):
    values = np.column_stack([*columns.values()])
    np.savetxt(path, values, "%.9g", ",", header=",".join(columns), comments="")


def write_record(path, rate, voltages=None, seed=0):
    """Write the motion of the stage under ``voltages``, or those of piezojax.excite."""
    if voltages is None:
        generator = Generator(0.0, 100.0, rate, 2e4)
        voltages = excitation(generator, seed)[1]
    system, time_s = stage(rate), np.arange(len(voltages)) / rate
    before = np.r_[voltages[0], voltages[:-1]]  # a voltage acts on the next sample
    _, motion = pj.simulate(system, before, system.init(voltages[0]))
    motion += 0.002 * np.random.default_rng(seed).standard_normal(len(voltages))
    write_columns(path, time_s=time_s, input_V=voltages, displacement_um=motion)


def write_response(path):
    """Write the response of the stage to small motions, from 10 Hz to 5 kHz."""
    frequency = np.geomspace(10.0, 5000.0, 1200)
    response = np.zeros(frequency.size, complex)
    for share, resonance, damping in ((0.8, 740.0, 0.02), (0.2, 1900.0, 0.03)):
        ratio = frequency / resonance
        response += 0.1 * share / (1.0 - ratio**2 + 2j * damping * ratio)
    random = np.random.default_rng(0).standard_normal((2, frequency.size))
    response *= 1.0 + 0.005 * (random[0] + 1j * random[1])
    response *= np.exp(-2j * np.pi * frequency * 1e-4)
    phase = np.rad2deg(np.unwrap(np.angle(response)))
    magnitude = np.abs(response)
    write_columns(path, frequency_Hz=frequency, magnitude=magnitude, phase_deg=phase)


def write_loop(path, controller, rate, reference, columns, digits=9):
    """Write the ``columns`` (functions of the log) of a loop around the stage."""
    plant = stage(rate)
    loop = pj.Feedback(controller, plant, pj.Saturation(-20.0, 130.0), pj.Sensor(0.002))
    noise = np.random.default_rng(0).standard_normal(reference.size)
    inputs = pj.loop_inputs(reference, noise)
    _, log = pj.simulate(loop, inputs, loop.init(reference[0]))
    write_columns(path, **{k: np.round(f(log), digits) for k, f in columns.items()})


def square(samples, half, low, high):
    return np.where(np.arange(samples) // half % 2, high, low)


def multisine(period, seed, highest):
    """Return one period of equal tones up to a share ``highest`` of the lines."""
    lines = np.zeros(period // 2 + 1, complex)
    tones = np.arange(1, int(highest * period / 2))
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, tones.size)
    lines[tones] = np.exp(1j * phases)
    signal = np.fft.irfft(lines, period)
    return signal / np.std(signal)


def start(folder, page):
    (folder / "play.py").write_text(blocks_in(page, "python")[0], encoding="utf-8")
    write_record(folder / "record.csv", 20_000.0)


def devices(folder, page):
    write_response(folder / "bench.csv")
    ranges = {"avmin": -20.0, "avmax": 130.0, "posmin": 0.0, "posmax": 12.0}
    controller = pj.control.NV200(0.06, 70.0, 0.0, scale=10.8, **ranges)
    columns = {
        "error_um": lambda log: log.reference - log.measured,
        "voltage_V": lambda log: log.voltage,
    }
    reference = square(6144, 512, 3.0, 3.5)
    write_loop(folder / "loop.csv", controller, 20_000.0, reference, columns, 3)


def identification(folder, page):
    mirror = pj.catalog.mirror.detailed_stage()
    for level in (100, 200, 300):
        for number in range(3):
            u = np.column_stack(
                [1e-3 * level * multisine(8192, [number, k], 0.5) for k in range(3)]
            )
            _, y = pj.simulate(mirror, np.tile(u, (3, 1)), mirror.init(u[0]))
            y = np.column_stack(y)[8192:]
            y += 0.003 * np.random.default_rng([level, number]).standard_normal(y.shape)
            inputs = {f"u{k}_V": np.tile(u[:, k], 2) for k in range(3)}
            outputs = {f"y{k}_um": y[:, k] for k in range(3)}
            path = folder / f"r{level}_{number}.npz"
            np.savez(path, fs=6400.0, **inputs, **outputs)
    write_response(folder / "bench.csv")
    pi = pj.control.PID(proportional=0.5, integral=300.0, dt=1e-4)
    columns = {
        "time_s": lambda log: np.arange(log.voltage.size) * 1e-4,
        "voltage_V": lambda log: log.voltage,
        "sensor_um": lambda log: log.measured,
        "reference_um": lambda log: log.reference,
    }
    random = np.random.default_rng(0).integers(0, 2, 1024)
    reference = 5.0 + 0.3 * np.repeat(random, 8)
    write_loop(folder / "loop.csv", pi, 10_000.0, reference, columns)
    for number in range(2):
        voltages = 50.0 + 2.0 * np.tile(multisine(10_000, number, 0.5), 5)
        write_record(folder / f"phase_{number}.csv", 20_000.0, voltages)
    write_record(folder / "slow.csv", 10_000.0)
    model = folder / "results/bench/model.json"
    model.parent.mkdir(parents=True)
    pj.save(stage(10_000.0), model, pj.About(record="bench.csv", rate_Hz=1e4))
    write_record(folder / "today.csv", 10_000.0, seed=1)


def export(folder, page):
    """Tune two studies with a small budget."""
    for name in ("p753_learned_inverse", "nv200"):
        study = folder / f"{name}.toml"
        shutil.copy(ROOT / "tuning" / study.name, study)
        shorten(study, {"optimiser": {"starts": 1, "candidates": 4, "steps": 4}})
        out = f"results/{name}"
        shell(f"python -m piezojax.tune {study.name} --no-sliders --out {out}", folder)
    saved = "[Device Parameters]\nkp = 0.010\nki = 20.000\nacserno = 12345\n"
    (folder / "saved.ini").write_text(saved, encoding="utf-8")


def recording(folder, page):
    """Tune gains for a first record."""
    write_record(folder / "first.csv", 10_000.0)
    shell("python -m piezojax.start first.csv --yes --out results/first", folder)


def sweeps(folder, page):
    shutil.copy(ROOT / "tuning/sweep_p753.toml", folder / "study.toml")


def trial(folder, page):
    study = write_study(folder)
    shell(f"python -m piezojax.tune {study.name} --out results/study", folder)


INPUTS = {
    make.__name__: make
    for make in (start, devices, identification, export, recording, sweeps, trial)
}
"""Functions by the name of a page that make its inputs in a folder, from its text."""


# Runs


def shorten(study, tables):
    """Replace values of the file ``study``."""
    content = tomllib.loads(study.read_text("utf-8"))
    for name, value in tables.items():
        whole = isinstance(value, dict)
        content[name] = content.get(name, {}) | value if whole else value
    study.write_text(tomli_w.dumps(content), encoding="utf-8")


def check_out(folder):
    """Make a git checkout of the files in the working tree."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.check_output(listing, cwd=ROOT, text=True).splitlines()
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    for arguments in (["init", "--quiet"], ["add", "--all"]):
        subprocess.run(["git", *arguments], cwd=folder, check=True)


def shell(command, folder, typed=None):
    """Run a command in a folder; return its status and output, both parts in one."""
    package = folder if (folder / "piezojax").is_dir() else ROOT
    paths = [str(package), os.environ.get("PYTHONPATH", "")]
    programs = [str(Path(sys.executable).parent), os.environ["PATH"]]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "PATH": os.pathsep.join(programs),
    }
    try:
        done = subprocess.run(
            ["sh", "-c", command],
            cwd=folder,
            env=environment,
            input=typed or "",
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LONGEST,
            check=False,
        )
    except subprocess.TimeoutExpired as late:
        return "timeout", str(late.stdout)
    return done.returncode, done.stdout


def name_of(path):
    folder = DOCS if path.is_relative_to(DOCS) else ROOT
    return path.relative_to(folder).with_suffix("").as_posix()


def commands_of(text):
    """Return the commands of a page, without comments."""
    lines = (re.sub(r"(^|\s+)#.*", "", line).strip() for line in scripts_in(text))
    return [" ".join(line.split()) for line in lines if line]


def pages_with_commands():
    """Return the texts of the pages with commands, by name."""
    texts = {name_of(path): path.read_text("utf-8") for path in PAGES}
    return {name: text for name, text in texts.items() if commands_of(text)}


def without_use(pages):
    """Return the keys of SPECIAL and INPUTS that no page needs any more."""
    shown = {command for text in pages.values() for command in commands_of(text)}
    return sorted((SPECIAL.keys() - shown) | (INPUTS.keys() - pages.keys()))


def ran(page, command, number, folder):
    """Run a command of a page as SPECIAL says."""
    special = SPECIAL.get(command, Special(""))
    if special.run is None:
        return Done(page, command, "skipped", note=special.note)
    if special.study:
        shorten(folder / special.study, special.tables)
    # A folder for results is new for each command.
    run = re.sub(r"\bDIR\b", f"results-{number}", special.run or command)
    begun = time.perf_counter()
    status, output = shell(run, folder, special.typed)
    seconds = time.perf_counter() - begun
    good = status in special.statuses
    outcome = f"status {status}" if good else f"status {status}, wrong"
    return Done(page, command, outcome, seconds, special.note, output[-3000:])


def run_page(name, text, console):
    """Yield the outcome of each command of a page."""
    commands = commands_of(text)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if any(OWN_FILE.search(command) for command in commands):
            check_out(folder)
        if name in INPUTS:
            console.print(f"{name}: makes its inputs")
            INPUTS[name](folder, text)
        for number, command in enumerate(commands):
            yield ran(name, command, number, folder)


def table_of(lines):
    table = Table(title="commands of the documentation")
    for head in ("page", "command", "status", "s", "note"):
        table.add_column(
            head, justify="right" if head == "s" else "left", overflow="fold"
        )
    for line in lines:
        seconds = f"{line.seconds:.0f}" if line.seconds else ""
        cells = line.page, line.command, line.outcome, seconds, line.note
        table.add_row(*map(Text, cells))
    return table


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--pages", metavar="NAME,NAME", help="as README,start; else all"
    )
    parser.add_argument("--list", action="store_true", help="show the commands alone")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    shown = pages_with_commands()
    if without := without_use(shown):
        parser.error(f"no page shows {without}: change SPECIAL or INPUTS")
    names = options.pages.split(",") if options.pages else [*shown]
    if missing := [name for name in names if name not in shown]:
        parser.error(f"no command is on {missing}; pages are {', '.join(shown)}")
    console = Console(width=None if sys.stdout.isatty() else 160)
    lines = []
    for name in names:
        if options.list:
            for command in commands_of(shown[name]):
                note = SPECIAL.get(command, Special("")).note
                lines.append(Done(name, command, "", note=note))
            continue
        for line in run_page(name, shown[name], console):
            lines.append(line)
            console.print(
                f"{name}: {line.command}: {line.outcome}, {line.seconds:.0f} s",
                soft_wrap=True,
                highlight=False,
                markup=False,
            )
            if line.outcome.endswith("wrong"):
                console.print(line.output, soft_wrap=True, markup=False)
            if options.json:
                rows = [each._asdict() for each in lines]
                options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    console.print(table_of(lines))
    wrong = sum(line.outcome.endswith("wrong") for line in lines)
    console.print(f"{len(lines)} commands, {wrong} with another status than expected")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
