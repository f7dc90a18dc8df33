"""Documentation: its links, generated pages, commands, and the site built from it."""

import importlib.util
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib import import_module

import click
import pytest
from shown_commands import DOCS, FENCED, OWN_FILE, PAGES, ROOT, scripts_in

from piezojax.study import shipped

CODE = re.compile(r"(`+)((?:(?!\n\n).)+?)\1", re.DOTALL)
LINK = re.compile(r"\]\(\s*([^)\s]+)\s*\)")
HEADING = re.compile(r"^#+ +(.*?)\s*$", re.MULTILINE)


def name(path):
    return path.relative_to(ROOT).as_posix()


def prose_of(text):
    """Return ``text`` without code."""
    return CODE.sub("", FENCED.sub("", text))


def anchors_of(text):
    """Return the anchors of the headings of a page, as zensical makes them."""
    found = []
    for heading in HEADING.findall(FENCED.sub("", text)):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.replace("`", ""))
        found.append(re.sub(r"[^\w\- ]", "", plain).strip().lower().replace(" ", "-"))
    return found


def dead_links(path, text):
    """Yield the links of the page ``path`` with that ``text`` that lead nowhere."""
    for target in LINK.findall(prose_of(text)):
        if re.match(r"\w+:", target):
            continue  # another site
        file, _, anchor = target.partition("#")
        page = (path.parent / file).resolve() if file else path
        inside = page.is_relative_to(DOCS) or not path.is_relative_to(DOCS)
        if not (page.exists() and inside):
            yield f"{target}: no such file in the site"
        elif anchor:
            other = text if page == path else page.read_text(encoding="utf-8")
            if anchor not in anchors_of(other):
                yield f"{target}: no such heading"


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_no_link_is_dead(path):
    assert [*dead_links(path, path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[a](goals.md#jumps) [b](https://example.org/x) [c](#here)\n## Here\n", []),
        ("[a](goal.md)", ["goal.md: no such file in the site"]),
        ("![a](images/no.png)", ["images/no.png: no such file in the site"]),
        ("[a](goals.md#jump)", ["goals.md#jump: no such heading"]),
        ("[a\nb](#here)", ["#here: no such heading"]),
        ("[a](../README.md)", ["../README.md: no such file in the site"]),
        ("`[a](no.md)`\n\n```\n[a](no.md)\n```\n", []),
    ],
)
def test_a_planted_link_is_found(text, expected):
    assert [*dead_links(DOCS / "index.md", text)] == expected


def test_the_site_shows_every_page_once():
    def files(entries):
        for entry in entries:
            values = entry.values() if isinstance(entry, dict) else [entry]
            for value in values:
                yield from files(value) if isinstance(value, list) else [value]

    nav = tomllib.loads((ROOT / "zensical.toml").read_text("utf-8"))["project"]["nav"]
    shown = sorted(files(nav))
    assert shown == sorted(p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md"))


WRITER = runpy.run_path(str(DOCS / "write_reference.py"))


@pytest.mark.parametrize("page", WRITER["PAGES"])
def test_generated_pages_are_those_of_the_code(page):
    """``python docs/write_reference.py`` writes them."""
    written = (DOCS / page).read_text(encoding="utf-8")
    assert written == WRITER["PAGES"][page]()


COMMAND = re.compile(r"python -m piezojax\.(\w+)(.*)")


def quoted_in(text):
    """Return the code within the sentences of a page, each on one line."""
    return [" ".join(code.split()) for _, code in CODE.findall(FENCED.sub("", text))]


def command_in(line):
    """Return the name and the arguments of the command of a line, None without one."""
    found = COMMAND.search(line)
    words = found and re.split(r"&&|[|;>]", re.sub(r"\$\w+", "1", found[2]))[0]
    return found and (found[1], shlex.split(words, comments=True))


def wrong_use(line, complete):
    """Return what is wrong with the command of ``line``, "" if nothing is.

    Only a ``complete`` command has all that is required.
    """
    command, arguments = command_in(line)
    if importlib.util.find_spec(f"piezojax.{command}") is None:
        return f"there is no command {command}"
    main = import_module(f"piezojax.cli.{command}").main
    context = click.Context(main)
    try:
        click.Command.parse_args(main, context, [*arguments])
    except click.MissingParameter as error:
        return error.format_message() if complete else ""
    except click.UsageError as error:
        message = error.format_message()
        return "" if "does not exist" in message else message
    study = arguments[0] if command in ("tune", "sweep") and arguments else ""
    if re.fullmatch(r"[a-z0-9_/]+", study):  # not a file, nor a placeholder
        try:
            shipped(study)
        except ValueError as error:
            return str(error)
    return ""


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_every_command_can_be_used(path):
    text = path.read_text(encoding="utf-8")
    lines = [(line, True) for line in scripts_in(text)]
    lines += [(line, False) for line in quoted_in(text)]
    shown = [(line, complete) for line, complete in lines if command_in(line)]
    wrong = {line: wrong_use(line, complete) for line, complete in shown}
    assert {line: why for line, why in wrong.items() if why} == {}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("python -m piezojax.tune p753_dob --out DIR  # a comment", ""),
        ("python -m piezojax.tune --schema > study.schema.json", ""),
        ("python -m piezojax.tune p753_dop", "p753_dop"),
        ("python -m piezojax.tune --baseline", "No such option"),
        ("python -m piezojax.export DIR --to cc", "'cc' is not one of"),
        ("python -m piezojax.excite --lower x", "'x' is not a valid float"),
        ("python -m piezojax.export DIR --before saved.ini", ""),
        ("python -m piezojax.start", "Missing argument 'RECORD'"),
        ("python -m piezojax.stop", "there is no command stop"),
    ],
)
def test_a_wrong_command_is_found(line, expected):
    found = wrong_use(line, complete=True)
    assert expected in found
    assert bool(expected) == bool(found)


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_named_files_of_the_repository_exist(path):
    text = path.read_text(encoding="utf-8")
    words = [
        word for line in scripts_in(text) + quoted_in(text) for word in line.split()
    ]
    files = [word for word in words if OWN_FILE.fullmatch(word)]
    folders = ROOT, ROOT / "piezojax"
    missing = [x for x in files if not any((folder / x).exists() for folder in folders)]
    assert missing == []


@pytest.mark.skipif(
    importlib.util.find_spec("zensical") is None,
    reason="zensical is missing: pip install '.[docs]'",
)
def test_the_site_is_built_strictly_and_needs_no_network(tmp_path):
    shutil.copytree(DOCS, tmp_path / "docs")
    for file in ("zensical.toml", "CONTRIBUTING.md"):
        shutil.copy(ROOT / file, tmp_path)
    (tmp_path / "piezojax").symlink_to(ROOT / "piezojax")
    done = subprocess.run(
        [sys.executable, "-m", "zensical", "build", "--strict", "--clean"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    pages = {
        page.name: page.read_text("utf-8") for page in tmp_path.rglob("site/**/*.html")
    }
    assert "ColemanHodgdon" in pages["hysteresis.html"]
    for page in pages.values():
        loaded = re.findall(r"<(?:script|img)[^>]* src=.?([^\s>]+)", page)
        loaded += re.findall(r"<link[^>]* rel=.?stylesheet[^>]* href=.?([^\s>]+)", page)
        assert not [file for file in loaded if "//" in file]
