"""What gcc says about the sources of the engine ``native``."""

import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import pytest

from piezojax.engines import native_library as library

needs_gcc = pytest.mark.skipif(
    sys.platform != "linux" or "gcc" not in (library.compiler() or ""),
    reason="the report is that of gcc",
)


def assert_simd(source):
    """Fail unless gcc turns the loops over the lanes of a step into SIMD.

    ``source`` are the arguments of ``library.registered``.
    """
    text = library._called(*source)
    flags = *library._flags(text), f"-I{jax.ffi.include_dir()}", "-fopt-info-vec"
    command = [library.compiler(), *flags, "-o", "run.so", "run.c", "-lm"]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "run.c").write_text(text, encoding="utf-8")
        report = subprocess.run(
            command, cwd=folder, check=True, capture_output=True, text=True
        ).stderr
    places = [
        int(line.split(":")[1])
        for line in report.splitlines()
        if "loop vectorized" in line
    ]
    for part in ("step_values", "step_slopes"):
        for number, line in enumerate(text.splitlines(), 1):
            if f"INLINE void {part}(" in line:
                assert any(number < place < number + 10 for place in places), report
