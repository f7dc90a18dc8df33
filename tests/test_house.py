"""Subpackages: imports point downwards only, and module names are unique."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import piezojax

SUBPACKAGES = (
    *("core", "scalar", "engines", "signals", "dynamics", "hysteresis", "hardware"),
    *("control", "analysis", "exporting", "solve", "identification", "catalog"),
    *("study", "stages", "tuning", "sweeping", "reproduction", "report", "cli"),
)
"""Subpackages from the lowest up: each may import those before it, so that ``cli``
alone imports ``report``."""

ENTRIES = (
    *("__init__", "tune", "identify", "validate", "sweep", "reproduce"),
    *("export", "start", "excite", "emulate", "trial", "retune", "learn", "watch"),
)
"""Modules at the top: they may import any subpackage; no subpackage imports them."""


def modules(package):
    """Return the dotted names of the modules below ``package``."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        is_package = parts[-1] == "__init__" and len(parts) > 1
        found[parts[:-1] if is_package else parts] = path, is_package
    return found


def imported(package, parts, path, is_package):
    """Yield line number and dotted parts of each import of the package itself.

    They include imports inside functions and under TYPE_CHECKING.
    """
    here = parts if is_package else parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                name = tuple(alias.name.split("."))
                if name[0] == package.name:
                    yield node.lineno, name[1:]
        if not isinstance(node, ast.ImportFrom):
            continue
        module = tuple(node.module.split(".")) if node.module else ()
        if node.level:
            base = (*here[: len(here) + 1 - node.level], *module)
        elif module and module[0] == package.name:
            base = module[1:]
        else:
            continue
        for alias in node.names:
            yield node.lineno, (*base, alias.name)


def violations(package):
    """Return the violations of the order of subpackages, one line each."""
    found, arrows, places = [], defaultdict(set), defaultdict(set)
    for parts, (path, is_package) in modules(package).items():
        subpackage, where = parts[0], ".".join(parts)
        if subpackage not in (*SUBPACKAGES, *ENTRIES):
            found.append(f"{where}: {subpackage} is not a subpackage")
            continue
        if not is_package and parts[-1] != "__init__" and len(parts) > 1:
            places[parts[-1]].add(subpackage)
        if subpackage in ENTRIES:
            continue
        for line, target in imported(package, parts, path, is_package):
            other = target[0] if target else "__init__"
            if other == subpackage:
                continue
            arrows[subpackage].add(other)
            if other not in SUBPACKAGES:
                found.append(f"{where}:{line} imports {other} from the top")
            elif SUBPACKAGES.index(other) > SUBPACKAGES.index(subpackage):
                found.append(f"{where}:{line} imports {other}, a subpackage above")
    mutual = ((a, b) for a in arrows for b in arrows[a] if a in arrows.get(b, ()))
    pairs = {tuple(sorted(pair)) for pair in mutual}
    found += [f"{one} and {other} import each other" for one, other in sorted(pairs)]
    found += [
        f"{name} is a module of {' and '.join(sorted(subpackages))}"
        for name, subpackages in sorted(places.items())
        if len(subpackages) > 1
    ]
    return found


def test_subpackages_import_downwards_and_share_no_names():
    assert violations(Path(piezojax.__file__).parent) == []


def test_every_subpackage_is_listed():
    package = Path(piezojax.__file__).parent
    subpackages = {parts[0] for parts in modules(package)}
    assert subpackages == {*SUBPACKAGES, *ENTRIES}


def test_reports_do_not_compute():
    """A report draws given numbers; it neither simulates nor solves."""
    for path in (Path(piezojax.__file__).parent / "report").glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = {
            name.split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in (
                [node.module or ""]
                if isinstance(node, ast.ImportFrom) and not node.level
                else [alias.name for alias in node.names]
            )
        }
        assert not names & {"jax", "equinox", "scipy", "simulate"}, path.name
        solved = {
            node.attr
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "np"
        }
        assert not solved & {"linalg", "fft", "polyfit"}, path.name


LEGAL = {
    "__init__.py": "from .cli import tune",
    "tune.py": "from .cli.tune import main",
    "core/__init__.py": "",
    "core/system.py": "import jax",
    "control/pid.py": "from ..core.system import System\nfrom . import design",
    "control/design.py": "from small.core import system",
    "report/bode.py": "from ..control.pid import PID",
    "cli/tune.py": "from ..report import bode",
}


@pytest.mark.parametrize(
    ("planted", "expected"),
    [
        ({}, []),
        (
            {"core/system.py": "from ..control.pid import PID"},
            [
                "core.system:1 imports control, a subpackage above",
                "control and core import each other",
            ],
        ),
        (
            {"core/paths.py": "def late():\n    import small.report.bode"},
            [
                "core.paths:2 imports report, a subpackage above",
            ],
        ),
        (
            {
                "core/paths.py": "from typing import TYPE_CHECKING\n"
                "if TYPE_CHECKING:\n    from ..analysis import margins"
            },
            ["core.paths:3 imports analysis, a subpackage above"],
        ),
        (
            {"core/paths.py": "from .. import solve"},
            ["core.paths:1 imports solve, a subpackage above"],
        ),
        (
            {"core/paths.py": "from .. import simulate"},
            ["core.paths:1 imports simulate from the top"],
        ),
        ({"core/pid.py": ""}, ["pid is a module of control and core"]),
        ({"utils/pid.py": ""}, ["utils.pid: utils is not a subpackage"]),
    ],
)
def test_a_planted_violation_is_found(tmp_path, planted, expected):
    package = tmp_path / "small"
    for name, text in (LEGAL | planted).items():
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert violations(package) == expected
