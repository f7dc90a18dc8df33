"""Test a seeded sample of the mutants of a module and list those that survive.

``python tests/mutations/sample.py [--modules FILE ...] [--count N] [--json FILE]``
draws N mutants of each module of modules.py. Cosmic Ray makes them (``pip install
'.[mutation]'``): other operators and comparisons, other numbers, negated conditions,
loops without a pass, and others. Each is tested in a copy of the tree; it is caught if
a test fails or takes too long. Survivors are shown as a difference. Exits with 1 if the
share caught is below the bar.

Omitted are mutants that leave every result of a correct program as it is, or that only
raise errors: of annotations, of the guards ``strict`` and ``frozen``, of ``overload``,
of ``jit`` and ``static``, which change the speed alone, of the examples in the
documentation of a table, orders of texts (``status <= "interrupted"``), and operators
of another group.
"""

import argparse
import ast
import contextlib
import difflib
import json
import multiprocessing
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import jaxtyping
import pytest
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from modules import MODULES
from run import ROOT, tree

BAR = 0.85
PATIENCE = 4.0
"""Factor on the time of the unchanged tests above which a mutant counts as caught."""

IMPORTED = ("jax", "equinox", "optimistix", "scipy.signal", "pytest", "control")
"""Imported once, before the processes of the mutants are forked."""

_ALIKE = {
    "ReplaceBinaryOperator": ({"Add", "Sub", "Mul", "Div", "Pow"}, {"BitAnd", "BitOr"}),
    "ReplaceComparisonOperator": (
        {"Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"},
        {"Is", "IsNot"},
    ),
}
"""Groups within which an operator is replaced, by the kind of mutation."""


_GUARDS = ("strict", "frozen", "static")
"""Keyword arguments that make a wrong program raise an error, or change its speed."""

_WITHOUT_EFFECT = ("jit", "overload")
"""What is part of the names of decorators that change no result."""

Place = tuple[int, int]


class Mutant(NamedTuple):
    """``occurrence`` of an operator of Cosmic Ray, and its first line."""

    operator: str
    occurrence: int
    line: int


def wanted(operator: str) -> bool:
    """Return whether mutants of an operator change what is computed."""
    kind, *replaced = operator.rpartition("/")[2].split("_")
    if kind in _ALIKE:
        return any(set(replaced) <= group for group in _ALIKE[kind])
    return not kind.startswith(("ExceptionReplacer", "NoOp", "Variable", "Keyword"))


def without_effect(source: str) -> list[tuple[Place, Place]]:
    """Return first and last place of what changes no result of a correct program."""
    nodes, spans = [], []
    for node in ast.walk(ast.parse(source)):
        nodes += [getattr(node, name, None) for name in ("annotation", "returns")]
        if isinstance(node, ast.keyword) and node.arg in _GUARDS:
            nodes.append(node.value)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "example":
            nodes.append(node)
        for decorator in getattr(node, "decorator_list", ()):
            if any(plain in ast.unparse(decorator) for plain in _WITHOUT_EFFECT):
                spans.append(((decorator.lineno, 0), span(decorator)[1]))  # from the @
    return spans + [span(node) for node in nodes if isinstance(node, ast.expr)]


def span(node: ast.expr) -> tuple[Place, Place]:
    """Return first and last place of an expression."""
    return (
        (node.lineno, node.col_offset),
        (node.end_lineno or node.lineno, node.end_col_offset or node.col_offset),
    )


def of_texts(source: str) -> list[tuple[Place, Place]]:
    """Return first and last place of comparisons with a text."""
    return [
        span(node)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Compare)
        for side in (node.left, *node.comparators)
        if isinstance(side, ast.Constant) and isinstance(side.value, str)
    ]


def inside(place: Place, spans: list[tuple[Place, Place]]) -> bool:
    return any(first <= place <= last for first, last in spans)


def mutants(source: str) -> dict[Place, list[Mutant]]:
    """Return the mutants of a module by the place that they change."""
    outside, texts, found = without_effect(source), of_texts(source), {}
    parsed = get_ast(source)
    for name in filter(wanted, operator_names()):
        operator, occurrence = get_operator(name)(), 0
        orders = name.rpartition("_")[2] in ("Lt", "LtE", "Gt", "GtE")
        for node in ast_nodes(parsed):
            for start, _ in operator.mutation_positions(node):
                if not inside(start, outside) and not (orders and inside(start, texts)):
                    mutant = Mutant(name, occurrence, start[0])
                    found.setdefault(start, []).append(mutant)
                occurrence += 1
    return found


def mutated_by(source: str, mutant: Mutant) -> str | None:
    """Return the source of a mutant, or None if it is no Python.

    The ``*`` before keyword-only arguments looks like a product to Cosmic Ray.
    """
    operator = get_operator(mutant.operator)()
    mutated = mutate_code(source, operator, mutant.occurrence)
    try:
        ast.parse(mutated)
    except SyntaxError:
        return None
    return mutated


def drawn(source: str, count: int, seed: int) -> list[tuple[Mutant, str]]:
    """Return at most ``count`` mutants with their sources, each of another place."""
    found, chance, chosen = mutants(source), random.Random(seed), []
    places = sorted(found)
    chance.shuffle(places)
    for place in places:
        mutant = chance.choice(found[place])
        mutated = mutated_by(source, mutant)
        if mutated is not None:
            chosen.append((mutant, mutated))
        if len(chosen) == count:
            break
    return sorted(chosen, key=lambda each: each[0].line)


def tested(copy: Path, tests: tuple[str, ...], caught) -> None:
    """Run the tests of a copy of the tree; set ``caught`` to pytest's exit status."""
    os.chdir(copy)
    sys.path[:0] = [str(copy), str(copy / "tests")]
    os.environ["PYTHONPATH"] = str(copy)
    sys.dont_write_bytecode = True
    # Otherwise the checks of annotations would catch mutants.
    jaxtyping.config.update("jaxtyping_disable", True)
    options = ["-q", "-x", "-o", "addopts=", "-p", "no:cacheprovider"]
    # Plugins are among the modules that were imported before.
    options += ["-W", "ignore:Module already imported:pytest.PytestWarning"]
    with open(os.devnull, "w") as quiet, contextlib.redirect_stdout(quiet):
        caught.value = int(pytest.main([*options, *tests]))


def outcome(context, copy, tests, limit) -> tuple[str, float]:
    """Return "caught", "survived" or "late", and the seconds."""
    status, begun = context.Value("i", -1), time.perf_counter()
    process = context.Process(target=tested, args=(copy, tests, status))
    process.start()
    process.join(limit)
    late = process.is_alive()
    if late:
        process.kill()
        process.join()
    seconds = time.perf_counter() - begun
    if late:
        return "late", seconds
    return ("survived" if status.value == 0 else "caught"), seconds


def difference(source: str, mutated: str) -> str:
    """Return the changed lines of a mutant."""
    lines = difflib.unified_diff(
        source.splitlines(), mutated.splitlines(), n=0, lineterm=""
    )
    return "\n".join(f"    {line}" for line in list(lines)[2:])


def tried(context, copy, file, chosen) -> dict:
    """Test the mutants ``chosen`` of a module; print and return the outcomes."""
    place, tests = copy / "piezojax" / file, MODULES[file]
    source, rows = place.read_text(encoding="utf-8"), []
    found, seconds = outcome(context, copy, tests, None)
    if found != "survived":
        raise SystemExit(f"{file}: its tests fail without a mutation")
    limit = 30.0 + PATIENCE * seconds
    for mutant, mutated in chosen:
        place.write_text(mutated, encoding="utf-8")
        try:
            found, seconds = outcome(context, copy, tests, limit)
        finally:
            place.write_text(source, encoding="utf-8")
        change = difference(source, mutated)
        print(f"{found:9s} {seconds:6.1f} s  {file}:{mutant.line}")
        if found == "survived":
            print(change)
        sys.stdout.flush()
        rows.append({**mutant._asdict(), "outcome": found, "change": change})
    caught = sum(row["outcome"] != "survived" for row in rows)
    print(f"{file}: {caught} of {len(rows)} caught")
    return {"file": file, "caught": caught, "of": len(rows), "rows": rows}


def main() -> int:
    """Print a line for each mutant; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--modules", nargs="+", metavar="FILE", default=list(MODULES))
    parser.add_argument("--count", type=int, default=30, help="mutants of each module")
    parser.add_argument("--seed", type=int, default=18)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    if unknown := set(options.modules) - set(MODULES):
        parser.error(f"{', '.join(sorted(unknown))}: modules.py names no tests")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(IMPORTED))
    parts = []
    with tempfile.TemporaryDirectory(prefix="piezojax-mutants-") as folder:
        copy = tree(Path(folder))
        for file in options.modules:
            source = (ROOT / "piezojax" / file).read_text(encoding="utf-8")
            chosen = drawn(source, options.count, options.seed)
            parts.append(tried(context, copy, file, chosen))
            if options.json:
                options.json.write_text(json.dumps(parts, indent=1) + "\n")
    caught, of = (sum(part[key] for part in parts) for key in ("caught", "of"))
    print(
        f"{caught} of {of} caught, {100.0 * caught / of:.0f} % (bar {100 * BAR:.0f} %)"
    )
    return int(caught < BAR * of)


if __name__ == "__main__":
    sys.exit(main())
