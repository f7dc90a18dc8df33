"""Check that the README quotes what its first command prints, within 5 %.

    python .ci/readme_figures.py

The README has a table of errors (nm) on held-out plants; ``result.json`` of the newest
run in ``results`` has the same rows under ``beside``.
"""

import json
import math
import re
import sys
from pathlib import Path

KEYS = "nominal_rms_um", "geomean_rms_um", "worst_rms_um", "sensitivity_peak"
UNKNOWN = "diverges", "unstable"


def quoted() -> dict[str, list[str]]:
    """Return the cells of each controller in the README."""
    lines = Path("README.md").read_text(encoding="utf-8").splitlines()
    first = lines.index("|---|---|---|---|---|") + 1
    rows = {}
    for line in lines[first:]:
        if not line.startswith("|"):
            break
        name, *cells = [cell.strip(" *") for cell in line.strip("|").split("|")]
        rows[re.sub(r"^tuned: .*", "tuned", name)] = cells
    return rows


def agrees(cell: str, value: float | None, scale: float) -> bool:
    """Return whether ``cell`` quotes ``value``."""
    if value is None or cell in UNKNOWN:
        return value is None and cell in UNKNOWN
    return math.isclose(float(cell), scale * value, rel_tol=0.05)


def main() -> None:
    """Exit with the rows that disagree."""
    files = Path("results").glob("p753_learned_inverse/**/result.json")
    newest = max(files, key=lambda file: file.stat().st_mtime)
    found = json.loads(newest.read_text(encoding="utf-8"))["beside"]
    wrong = [
        f"README.md: {name}, {key} is {cell}; {newest} has {found[name][key]}"
        for name, cells in quoted().items()
        for key, cell in zip(KEYS, cells, strict=True)
        if not agrees(cell, found[name][key], 1e3 if key.endswith("um") else 1.0)
    ]
    sys.exit("\n".join(wrong) or 0)


if __name__ == "__main__":
    main()
