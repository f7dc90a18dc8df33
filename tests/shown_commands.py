"""Code that the pages of the documentation show."""

import re
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])

FENCED = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
OWN_FILE = re.compile(r"(?:docs|notebooks|piezojax|tests|tuning)/[\w./-]*\w")


def blocks_in(text, kind):
    """Return the code blocks of a page that have that ``kind``."""
    found = FENCED.findall(text)
    return [textwrap.dedent(code) for _, other, code in found if other == kind]


def scripts_in(text):
    """Return the lines of the scripts of a page, with continued lines joined."""
    scripts = blocks_in(text, "sh")
    return [line for code in scripts for line in code.replace("\\\n", " ").splitlines()]
