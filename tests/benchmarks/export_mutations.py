"""Mutations of an exported source: each must fail the test that is exported with it.

    python tests/benchmarks/export_mutations.py [--controller NAME] [--count 20]

One character of the functions ``init`` and ``step`` is changed, drawn at random: an
operator, a comparison, or a digit of a number or variable. A mutation that does not
compile counts as found. Exits with 1 if one passes.
"""

import argparse
import random
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import piezojax as pj
from piezojax.catalog import CONTROLLERS

CHANGES = {"+": "-", "-": "+", "*": "/", "/": "*", "<": ">", ">": "<"}


def places(text):
    """Yield position and replacement of each character that may change."""
    begin = text.index("_init(")
    for found in re.finditer(r" ([-+*/<>]) |(?<=[\w.])(\d)(?=[;\d ])", text[begin:]):
        group = 1 if found.group(1) else 2
        old = found.group(group)
        new = CHANGES.get(old) or str((int(old) + 1) % 10)
        yield begin + found.start(group), new


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--controller", default="p753_disturbance_observer")
    parser.add_argument("--count", type=int, default=20)
    chosen = parser.parse_args()
    about = pj.About(judged=["not here"], reference_ranges=[(0.0, 10.0)])
    passed = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "c"
        source = pj.export(
            CONTROLLERS[chosen.controller](),
            folder,
            about=about,
            limits=[(-20.0, 120.0)],
        )[1]
        text = source.read_text()
        drawn = random.Random(20).sample([*places(text)], chosen.count)
        for position, new in drawn:
            changed = text[:position] + new + text[position + 1 :]
            source.write_text(changed)
            done = subprocess.run(["make", "test"], cwd=folder, capture_output=True)
            line = changed[: changed.index("\n", position)].rpartition("\n")[2].strip()
            word = "FAILED TO FAIL" if done.returncode == 0 else "found"
            print(f"{text[position]} -> {new}: {word}: {line}")
            if done.returncode == 0:
                passed.append(line)
    print(f"{chosen.count - len(passed)} of {chosen.count} mutations found")
    return int(bool(passed))


if __name__ == "__main__":
    sys.exit(main())
