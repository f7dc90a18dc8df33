"""Check that the README quotes the errors that its first command prints, within 10 %.

    python .ci/readme_figures.py

The last row of the README's table has the errors (nm) and Ms of the tuned loop;
``result.json`` of the newest run in ``results`` has them, too.
"""

import json
import math
import re
import sys
from pathlib import Path

SCALES = {
    "nominal_rms_um": 1e3,
    "geomean_rms_um": 1e3,
    "worst_rms_um": 1e3,
    "sensitivity_peak": 1.0,
}


def main() -> None:
    """Exit with the figures that disagree."""
    row = re.search(r"^\| \*\*tuned: .*$", Path("README.md").read_text("utf-8"), re.M)
    assert row is not None
    quoted = [float(cell.strip(" *")) for cell in row[0].strip("|").split("|")[1:]]
    files = Path("results").glob("p753_learned_inverse/**/result.json")
    newest = max(files, key=lambda file: file.stat().st_mtime)
    found = json.loads(newest.read_text("utf-8"))["beside"]["tuned"]
    wrong = [
        f"README.md: {key} of the tuned loop is {cell}; {newest} has {found[key]}"
        for (key, scale), cell in zip(SCALES.items(), quoted, strict=True)
        if not math.isclose(cell, scale * (found[key] or math.inf), rel_tol=0.1)
    ]
    sys.exit("\n".join(wrong) or 0)


if __name__ == "__main__":
    main()
