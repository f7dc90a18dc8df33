"""Apply each mutation to a copy of the tree and check that its tests fail.

``python tests/mutations/run.py [--only NAME ...] [--json FILE]``: a mutation is caught
if the tests named with it fail, and survives if they pass. Exits with 1 if a mutation
survives or is not tested.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from table import MUTATIONS, Mutation

ROOT = Path(__file__).parents[2]
COPIED = ("piezojax", "tests", "tuning", "pyproject.toml")
FAILED = 1
"""Exit status of pytest if a test failed; other values mean that it did not run."""


def tree(folder: Path) -> Path:
    """Copy the files that the tests need to ``folder``; link the shared records."""
    copy = folder / "main"
    copy.mkdir()
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(source, copy / name, ignore=ignored)
        elif source.exists():
            shutil.copy(source, copy / name)
    shared = ROOT.parent / "shared"
    if shared.exists():
        (folder / "shared").symlink_to(shared)
    return copy


def outcome(copy: Path, mutation: Mutation) -> tuple[str, float]:
    """Return "caught", "survived" or the reason for no test, and the seconds."""
    place = copy / "piezojax" / mutation.file
    if not place.is_file():
        return f"not tried: no {mutation.file}", 0.0
    whole = place.read_text(encoding="utf-8")
    if (count := whole.count(mutation.old)) != 1:
        return f"not tried: the text is there {count} times", 0.0
    begun = time.perf_counter()
    place.write_text(whole.replace(mutation.old, mutation.new), encoding="utf-8")
    try:
        done = subprocess.run(
            [
                *(sys.executable, "-B", "-m", "pytest", "-q", "-x", "-n0"),
                *("-p", "no:cacheprovider", *mutation.tests),
            ],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        place.write_text(whole, encoding="utf-8")
    seconds = time.perf_counter() - begun
    if done.returncode == 0:
        return "survived", seconds
    if done.returncode == FAILED:
        return "caught", seconds
    last = (done.stdout + done.stderr).strip().splitlines()[-1:]
    return f"not tried: {' '.join(last)}", seconds


def main() -> int:
    """Print a line for each mutation; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="part of a name")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    chosen = [
        m
        for m in MUTATIONS
        if not options.only or any(o in m.name for o in options.only)
    ]
    if not chosen:
        parser.error("no mutation of that name")
    rows = []
    with tempfile.TemporaryDirectory(prefix="piezojax-mutations-") as folder:
        copy = tree(Path(folder))
        for mutation in chosen:
            found, seconds = outcome(copy, mutation)
            print(f"{found:9s} {seconds:6.1f} s  {mutation.file}: {mutation.name}")
            sys.stdout.flush()
            rows.append(
                {
                    "name": mutation.name,
                    "file": mutation.file,
                    "outcome": found,
                    "seconds": round(seconds, 1),
                }
            )
            if options.json:
                options.json.write_text(json.dumps({"rows": rows}, indent=2) + "\n")
    caught = sum(row["outcome"] == "caught" for row in rows)
    print(f"{caught} of {len(rows)} caught")
    return int(caught < len(rows))


if __name__ == "__main__":
    sys.exit(main())
