"""The tables of mutations apply to the code; run.py and sample.py take minutes."""

import re
from pathlib import Path

import pytest

from mutations.modules import MODULES
from mutations.table import MUTATIONS

ROOT = Path(__file__).parents[2]


def test_names_differ():
    assert len({mutation.name for mutation in MUTATIONS}) == len(MUTATIONS)


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name)
def test_every_mutation_applies_to_the_code(mutation):
    text = (ROOT / "piezojax" / mutation.file).read_text(encoding="utf-8")
    assert text.count(mutation.old) == 1
    assert mutation.new != mutation.old
    files = [part for part in mutation.tests if part.endswith(".py")]
    assert files
    assert all((ROOT / file).is_file() for file in files)
    # Names after -k: one that no test has leaves the mutation untried.
    if "-k" in mutation.tests:
        word = mutation.tests[mutation.tests.index("-k") + 1]
        texts = [(ROOT / file).read_text(encoding="utf-8") for file in files]
        assert re.search(rf"def test\w*{word}", "".join(texts))


@pytest.mark.parametrize("file", MODULES)
def test_sampled_modules_and_their_tests_exist(file):
    assert (ROOT / "piezojax" / file).is_file()
    files = [part for part in MODULES[file] if part.endswith(".py")]
    assert files
    assert all((ROOT / name).is_file() for name in files)
