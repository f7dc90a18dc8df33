"""Start-up time of imports and commands, relative to an import of JAX alone.

    python tests/benchmarks/startup.py [--runs N] [--json FILE]

New interpreters run in turn: the reference ``import jax, equinox, optimistix``,
``import piezojax``, the same with its functions used, and ``--help`` of every command.
The table has a line for each: median seconds, and the median ratio to the reference of
the same turn. Exits with 1 if a ratio is above its bar.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

YARDSTICK = "import jax, equinox, optimistix"
COMMANDS = ("tune", "identify", "validate", "export", "sweep", "reproduce")
CASES = {
    YARDSTICK: (["-c", YARDSTICK], None),
    "import piezojax": (["-c", "import piezojax"], 1.25),
    "piezojax.simulate": (["-c", "import piezojax; piezojax.simulate"], None),
    "piezojax.tune": (["-c", "import piezojax; piezojax.tune"], None),
    **{
        f"{name} --help": (["-m", f"piezojax.{name}", "--help"], 0.5)
        for name in COMMANDS
    },
}
"""Arguments of Python, and the largest allowed ratio."""


def seconds(arguments):
    """Run Python once; return the wall time, s."""
    begun = time.perf_counter()
    subprocess.run(
        [sys.executable, *arguments],
        check=True,
        stdout=subprocess.DEVNULL,
        env={k: v for k, v in os.environ.items() if k != "XLA_FLAGS"},
    )
    return time.perf_counter() - begun


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    for arguments, _ in CASES.values():
        seconds(arguments)  # fill the bytecode and disk caches
    turns = [
        {name: seconds(arguments) for name, (arguments, _) in CASES.items()}
        for _ in range(options.runs)
    ]
    rows = []
    for name, (_, bar) in CASES.items():
        ratio = statistics.median(turn[name] / turn[YARDSTICK] for turn in turns)
        median = statistics.median(turn[name] for turn in turns)
        rows.append(
            {"what": name, "seconds_median": median, "ratio": ratio, "bar": bar}
        )
        shown = "" if bar is None else f"  (at most {bar:g})"
        print(f"{name:34s} {median:6.2f} s  {ratio:5.2f} x{shown}")
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=2) + "\n")
    return int(any(row["bar"] and row["ratio"] > row["bar"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
