"""Reading of a few hundred mutated files; run.py reads any number."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from fuzz import check, corpus

RUN = Path(__file__).with_name("run.py")
MODEL = corpus.Case("model", "a.json", b'{"type": "Affine"}')


def test_mutated_files_work_or_give_one_line_errors():
    # In a separate process, because this one checks annotations before values.
    command = [sys.executable, str(RUN), "--cases", "300", "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 faults in 300 cases of seed 1" in done.stdout
    for kind in ("model", "record", "study"):
        for status in ("works", "refused"):
            assert f"{kind:8} {status:24}" in done.stdout


def test_a_case_is_reproducible():
    cases = [corpus.case(7, number) for number in range(20)]
    assert cases == [corpus.case(7, number) for number in range(20)]
    assert cases != [corpus.case(8, number) for number in range(20)]


def raising(error):
    def load(path):
        raise error

    return load


@pytest.mark.parametrize(
    ("load", "status"),
    [
        (lambda path: None, "works"),
        (raising(ValueError("a.json: no")), "refused"),
        (raising(ValueError("")), "not one line"),
        (raising(ValueError("one\ntwo")), "not one line"),
        (raising(ValueError("a" * 5000)), "not one line"),
        (raising(OverflowError("int too large")), "OverflowError"),
        (raising(RecursionError()), "RecursionError"),
        (lambda path: time.sleep(2.0), "too slow"),
    ],
)
def test_faults_are_detected(monkeypatch, tmp_path, load, status):
    monkeypatch.setattr(check, "load_system", load)
    monkeypatch.setattr(check, "LIMIT", 0.05)
    outcome = check.run(MODEL, tmp_path)
    assert outcome.status == status
    assert outcome.seconds < 1.0
    assert not list(tmp_path.iterdir())
