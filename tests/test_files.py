"""Results are written completely or not at all, and never overwrite older ones."""

import os
import stat
import subprocess
import sys

import pytest

from piezojax.core import files
from piezojax.core.files import fresh_folder, numbered_folder, write_bytes, write_text
from piezojax.core.temporaries import FOREIGN, claimed, remove_stale, temporary


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_write_text(tmp_path):
    write_text(tmp_path / "a.txt", "µm\n")
    assert (tmp_path / "a.txt").read_bytes() == b"\xc2\xb5m\n"
    assert names(tmp_path) == ["a.txt"]


def test_written_files_can_be_read_by_others(tmp_path):
    write_text(tmp_path / "a.txt", "x")
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o644


def test_names_of_files_are_moved_to_another_folder(tmp_path):
    base, folder = tmp_path / "a", tmp_path / "b" / "c"
    for path in (base, folder):
        path.mkdir(parents=True)
    assert files.seen_from(folder, base / "model.json") == "../../a/model.json"
    assert files.seen_from(base, base / "data/model.json") == "data/model.json"
    assert files.seen_from(folder, tmp_path / "model.json") == "../../model.json"


def test_writing_again_replaces(tmp_path):
    write_bytes(tmp_path / "a.bin", b"a long first version")
    write_bytes(tmp_path / "a.bin", b"short")
    assert (tmp_path / "a.bin").read_bytes() == b"short"


class DiskFullError(OSError):
    pass


def disk_full(*_):
    raise DiskFullError(28, "No space left on device")


def interrupt(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("step", ["write_bytes", "chmod", "replace"])
@pytest.mark.parametrize(
    ("fault", "kind"), [(disk_full, DiskFullError), (interrupt, KeyboardInterrupt)]
)
def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch, step, fault, kind):
    path = tmp_path / "result.json"
    write_text(path, "old")
    if step == "write_bytes":

        def half_written(file, content):
            file.write_text(content[:1].decode())
            fault()

        monkeypatch.setattr(files.Path, "write_bytes", half_written)
    else:
        monkeypatch.setattr(files.os, step, fault)
    with pytest.raises(kind):
        write_text(path, "new and longer")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["result.json"]


def test_a_fresh_folder_is_created_with_its_parents(tmp_path):
    path = tmp_path / "a" / "b"
    assert fresh_folder(path) == path
    assert path.is_dir()
    assert names(path) == []


def test_an_empty_folder_is_accepted(tmp_path):
    assert fresh_folder(tmp_path) == tmp_path
    assert names(tmp_path) == []


@pytest.mark.parametrize("occupant", ["result.json", ".hidden"])
def test_a_used_folder_is_refused_and_left_alone(tmp_path, occupant):
    (tmp_path / occupant).write_text("mine")
    with pytest.raises(ValueError, match="already holds results; name a new") as caught:
        fresh_folder(tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert names(tmp_path) == [occupant]
    assert (tmp_path / occupant).read_text() == "mine"


def test_a_file_is_refused_as_a_folder(tmp_path):
    path = tmp_path / "out"
    path.write_text("mine")
    with pytest.raises(ValueError, match=f"--out {path} cannot be written: File exi"):
        fresh_folder(path)
    assert path.read_text() == "mine"


def test_a_folder_under_a_file_cannot_be_written(tmp_path):
    # Fails even for root, unlike a folder without write permission.
    (tmp_path / "file").write_text("mine")
    path = tmp_path / "file" / "sub"
    with pytest.raises(ValueError, match=f"--out {path} cannot be written: Not a dir"):
        fresh_folder(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
@pytest.mark.parametrize("below", ["", "sub"])
def test_a_folder_without_permission(tmp_path, below):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(ValueError, match="cannot be written: Permission denied"):
            fresh_folder(tmp_path / below)
    finally:
        tmp_path.chmod(0o700)


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.Path, "touch", refuse)
    with pytest.raises(ValueError, match="cannot be written: Permission denied"):
        fresh_folder(tmp_path / "new")


def test_numbered_folders(tmp_path):
    stem = tmp_path / "p753"
    assert numbered_folder(stem) == stem
    assert not stem.exists()
    stem.mkdir()
    assert numbered_folder(stem) == stem  # empty: still free
    (stem / "result.json").write_text("{}")
    assert numbered_folder(stem) == tmp_path / "p753-2"
    (tmp_path / "p753-2").write_text("a file of that name is in the way")
    assert numbered_folder(stem) == tmp_path / "p753-3"
    assert numbered_folder(stem) == fresh_folder(numbered_folder(stem))


# Temporary files of killed runs

LEAVE = """
import os, signal, sys
from pathlib import Path
from piezojax.core.temporaries import claimed, temporary
folder = Path(sys.argv[1])
with claimed(folder), temporary(folder / "result.json") as file:
    file.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def litter_names(tmp_path_factory):
    """Kill a process that writes in a claimed folder; return the remaining files."""
    folder = tmp_path_factory.mktemp("out")
    subprocess.run([sys.executable, "-c", LEAVE, folder], check=False)
    found = names(folder)
    assert [name.split(".")[1] for name in found] == ["result", "running"]
    return found


@pytest.fixture
def litter(litter_names, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    for name in litter_names:
        (folder / name).touch()
    return folder


def test_the_next_run_removes_files_of_a_killed_run(litter):
    assert numbered_folder(litter) == litter
    assert names(litter) == []


def test_a_folder_of_a_killed_run_is_used_again(litter):
    assert fresh_folder(litter) == litter
    assert names(litter) == []


def test_results_of_a_killed_run_are_kept_and_its_temporary_files_are_not(
    litter, litter_names
):
    inner = litter / "models" / "lag"
    inner.mkdir(parents=True)
    (inner / "fit.json").write_text("{}")
    for name in litter_names:
        (inner / name).touch()
    with pytest.raises(ValueError, match="already holds results"):
        fresh_folder(litter)
    assert names(litter) == ["models"]
    assert names(inner) == ["fit.json"]


def test_files_in_use_are_kept(tmp_path):
    with temporary(tmp_path / "result.json") as own:
        # The parent of this process runs at least as long as this one.
        process, parent = f".{os.getpid()}.", f".{os.getppid()}."
        other = tmp_path / own.name.replace(process, parent)
        other.touch()
        remove_stale(tmp_path)
        assert names(tmp_path) == sorted([own.name, other.name])
    assert names(tmp_path) == [other.name]


def test_a_file_of_an_earlier_process_with_this_number_is_stale(tmp_path):
    with temporary(tmp_path / "result.json") as own:
        name = own.name
    (tmp_path / name).touch()
    remove_stale(tmp_path)
    assert names(tmp_path) == []


@pytest.mark.parametrize(("age", "left"), [(0.0, 1), (2.0 * FOREIGN, 0)])
def test_files_of_another_machine_are_judged_by_their_age(tmp_path, age, left):
    path = tmp_path / ".result.json.elsewhere.1.0123abcd.part"
    path.touch()
    then = path.stat().st_mtime - age
    os.utime(path, (then, then))
    remove_stale(tmp_path)
    assert len(names(tmp_path)) == left


@pytest.mark.parametrize("name", [".hidden.part", "a.host.1.0123abcd.part", ".nfs01"])
def test_files_of_other_users_are_kept(tmp_path, name):
    (tmp_path / name).touch()
    remove_stale(tmp_path)
    assert names(tmp_path) == [name]


def test_a_folder_in_use_is_refused(tmp_path):
    stem = tmp_path / "p753"
    stem.mkdir()
    with claimed(stem) as alone:
        assert alone
        assert numbered_folder(stem) == tmp_path / "p753-2"
        with pytest.raises(ValueError, match=r"p753 is in use by a running command"):
            fresh_folder(stem)
        with claimed(stem) as second:
            assert not second
    assert fresh_folder(stem) == stem
