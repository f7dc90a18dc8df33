"""Exported C under another compiler, an analyser and on an emulated Cortex-M4.

These are skipped where the programs are not installed; test_export.py has the compiler
of the system.
"""

import functools

import pytest
from c_tools import TOOLS, missing

import piezojax as pj
from piezojax.catalog import CONTROLLERS, PLANTS

ABOUT = pj.About(judged=["fine"], reference_ranges=[(0.0, 10.0)])
EXPORTS = {
    "p753_disturbance_observer": "controller",
    "p753_repetitive": "controller",  # a line of 1992 samples
    "p558_pid": "controller",  # three axes
    "p753_stage": "plant",
}


@pytest.fixture(scope="module", params=TOOLS)
def tool(request):
    """Return the name of an installed tool."""
    if missing(request.param):
        pytest.skip(f"not installed: {', '.join(missing(request.param))}")
    return request.param


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a function that exports a System, once, and returns its folder."""
    root = tmp_path_factory.mktemp("c")
    return functools.cache(lambda name: exported(name, root / name))


def exported(name, folder):
    """Export a System of the catalogue; return the folder."""
    system = (CONTROLLERS | PLANTS)[name]()
    about, limits = ABOUT, [(-20.0, 120.0)]
    if name.startswith("p558"):
        about = pj.About(judged=["fine"], reference_ranges=[(-9.0, 9.0)] * 3)
        limits *= 3
    options = {"about": about, "limits": limits} if name in CONTROLLERS else {}
    pj.export(system, folder, **options)
    return folder


@pytest.mark.parametrize("name", EXPORTS)
def test_tools_accept_the_source_and_repeat_the_simulation(tool, name, folders):
    assert TOOLS[tool][1](folders(name), EXPORTS[name]) == ""


SIGN = ("reference - measured", "reference + measured")
MISTAKES = {
    "clang": (*SIGN, "FAILED"),
    "cppcheck": ("parameters = {0};", "parameters;", "uninit"),
    "cortex-m4": (*SIGN, "FAILED"),
}
"""Text, its replacement, and a word of the complaint."""


def test_tools_find_a_mistake(tool, tmp_path):
    right, wrong, complaint = MISTAKES[tool]
    folder = exported("p753_pid", tmp_path / "c")
    source = folder / "controller.c"
    text = source.read_text()
    assert right in text
    source.write_text(text.replace(right, wrong))
    assert complaint in TOOLS[tool][1](folder, "controller")
