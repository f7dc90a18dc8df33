"""``python tests/fuzz/run.py --cases 10000``: read mutated files, list the faults."""

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
SILENT = 60.0
"""Time (s) without output after which a process counts as hung."""


def work(seed: int, first: int, last: int) -> None:
    """Run cases and print a JSON line for each; the parent watches the time."""
    sys.path.insert(0, str(HERE.parents[1]))
    from fuzz.check import run
    from fuzz.corpus import case

    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, last):
            one = case(seed, number)
            outcome = run(one, Path(folder))
            print(json.dumps([number, one.kind, one.name, *outcome]), flush=True)


def outcomes(seed: int, first: int, last: int):
    """Yield the outcome of each case; a process that hangs or dies is replaced."""
    import selectors

    while first < last:
        command = [sys.executable, str(HERE), "--seed", str(seed)]
        command += ["--first", str(first), "--cases", str(last - first), "--worker"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            selector = selectors.DefaultSelector()
            selector.register(process.stdout, selectors.EVENT_READ)
            while first < last:
                line = process.stdout.readline() if selector.select(SILENT) else ""
                if not line:
                    process.kill()
                    fault = "died or hung"
                    yield [first, "?", "?", fault, "", SILENT]
                    first += 1
                    break
                yield json.loads(line)
                first += 1


def main() -> int:
    """Run the cases; return 1 if one of them shows a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=2013)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    last = options.first + options.cases
    if options.worker:
        work(options.seed, options.first, last)
        return 0
    counts: Counter[tuple[str, str]] = Counter()
    slowest: list[Any] = [0, "", "", "", "", 0.0]
    faults = 0
    for outcome in outcomes(options.seed, options.first, last):
        number, kind, name, status, detail, seconds = outcome
        counts[kind, status] += 1
        slowest = max(slowest, outcome, key=lambda one: one[-1])
        if status not in ("works", "refused"):
            faults += 1
            print(f"case {number} ({name}): {status}, {seconds:.1f} s\n{detail}")
    for (kind, status), count in sorted(counts.items()):
        print(f"{kind:8} {status:24} {count:6}")
    print(f"{faults} faults in {options.cases} cases of seed {options.seed}")
    print(f"slowest: case {slowest[0]} ({slowest[2]}), {slowest[-1]:.2f} s")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
