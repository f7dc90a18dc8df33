"""Exported folders that the compiler of the system builds and tests."""

import shutil
import subprocess

import pytest

compiled = pytest.mark.skipif(
    shutil.which("cc") is None or shutil.which("make") is None,
    reason="there is no C compiler",
)


def made(folder):
    """Run ``make test`` in a folder; return its exit status and output."""
    done = subprocess.run(
        ["make", "-s", "test"], cwd=folder, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr
