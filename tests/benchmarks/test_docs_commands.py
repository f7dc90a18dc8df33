"""The runner of the documentation's commands finds a wrong status."""

import importlib
import sys
from pathlib import Path

import pytest
from rich.console import Console

# The benchmark is a script beside its modules, not a package.
sys.path.insert(0, str(Path(__file__).parent))
runner = importlib.import_module("docs_commands")

PAGE = """
```sh
touch DIR
  test -f \\
    results-0  # made before
exit 3
```
"""


def outcomes():
    lines = runner.run_page("page", PAGE, Console(quiet=True))
    return [line.outcome for line in lines]


def test_a_wrong_status_is_found(monkeypatch):
    assert outcomes() == ["status 0", "status 0", "status 3, wrong"]
    monkeypatch.setitem(runner.SPECIAL, "exit 3", runner.Special("", statuses=(3,)))
    assert outcomes() == ["status 0", "status 0", "status 3"]
    monkeypatch.setitem(runner.SPECIAL, "exit 3", runner.Special("no", None))
    assert outcomes() == ["status 0", "status 0", "skipped"]


def test_each_special_command_and_each_page_with_inputs_is_shown():
    pages = runner.pages_with_commands()
    assert runner.without_use(pages) == []
    assert runner.without_use({"start": pages["start"]})


@pytest.mark.parametrize("shown", [True, False])
def test_a_checkout_is_made_if_a_command_names_its_files(shown):
    name = "tests/shown_commands.py" if shown else "shown_commands.py"
    text = f"```sh\ntest -f {name}\n```\n"
    (line,) = runner.run_page("page", text, Console(quiet=True))
    assert line.outcome == ("status 0" if shown else "status 1, wrong")
