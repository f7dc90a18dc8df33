"""Checks of an exported folder by clang, by cppcheck, and on a Cortex-M4.

Each check runs programs of the system and returns their complaint, or "". The ARM check
runs the test program of the folder in an emulator of the processor, without an
operating system: files are read through the debugger's interface (semihosting).
"""

import shutil
import subprocess

START = """\
extern void _start(void);
static void reset(void) {
    *(volatile unsigned *)0xE000ED88 |= 0xFu << 20; /* switch the FPU on */
    _start();
}
__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    (void (*)(void))0x20400000, reset}; /* end of the stack, first instruction */
"""

CORTEX = (
    "arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 "
    "--specs=rdimon.specs "
    "-Wl,--section-start=.vectors=0,-Ttext-segment=0x1000,-Tdata=0x20000000 start.c"
)
"""Compiler for the processor: code at the start of its memory, data in its RAM."""

BOARD = (
    *("qemu-system-arm", "-M", "mps2-an386", "-cpu", "cortex-m4"),
    *("-display", "none", "-serial", "null", "-monitor", "none"),
    "-semihosting-config",
    "enable=on,target=native,arg=test,arg=vectors.csv",
    "-kernel",
)


LIMIT = 120.0
"""Seconds after which a tool is stopped: cppcheck does not end on the longest steps."""


def complaint(command, folder):
    """Run a command in ``folder``; return its text if it fails or prints a warning."""
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=LIMIT
        )
    except subprocess.TimeoutExpired:
        return f"{command[0]} did not end within {LIMIT:g} s"
    text = done.stdout + done.stderr
    return text or str(done.returncode) if done.returncode else done.stderr


def built(compiler, target, folder):
    """Make ``target`` anew with ``compiler`` and the flags of the exported Makefile."""
    return complaint(["make", "-Bs", f"CC={compiler}", target], folder)


def by_clang(folder, name):
    """Compile with clang and replay the golden vectors."""
    return built("clang", "test", folder)


def analysed(folder, name):
    """Analyse the source with cppcheck, but not the style of generated clamps."""
    return complaint(
        [
            *("cppcheck", "--std=c99", "--enable=warning,performance,portability"),
            *("--quiet", "--error-exitcode=1", f"{name}.c"),
        ],
        folder,
    )


def on_cortex(folder, name):
    """Replay the golden vectors on an emulated Cortex-M4, double in software."""
    (folder / "start.c").write_text(START)
    program = f"test_{name}"
    return built(CORTEX, program, folder) or complaint([*BOARD, program], folder)


TOOLS = {
    "clang": (["clang", "make"], by_clang),
    "cppcheck": (["cppcheck"], analysed),
    "cortex-m4": (["arm-none-eabi-gcc", "qemu-system-arm", "make"], on_cortex),
}
"""Programs that a check needs, and the check, by name."""


def missing(tool):
    """Return the programs of ``tool`` that this machine lacks."""
    return [program for program in TOOLS[tool][0] if shutil.which(program) is None]
