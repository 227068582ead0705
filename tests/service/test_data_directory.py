"""What cannot be a data directory is refused in one line that says what to do, and left alone."""

import os
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from gpom_core.config import MapConfig
from service.archive import Archive
from service.clock import SystemClock
from service.errors import JournalError
from service.settings import JournalSettings

NOBODY = 65534


def archive(directory: Path, site: str | None = None) -> Archive:
    return Archive(directory, JournalSettings(), MapConfig(), SystemClock(), site)


@pytest.fixture
def in_sight() -> Iterator[Path]:
    """A folder that others can look into, unlike those of pytest."""
    with TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@contextmanager
def as_nobody() -> Iterator[None]:
    """For this process, what root owns is not its own; tests of others run as who they are."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


def refused(directory: Path, told: str) -> None:
    with pytest.raises(JournalError, match=told) as caught:
        archive(directory).open()
    assert len(str(caught.value).splitlines()) == 1


def used(directory: Path) -> Path:
    """A data directory with a journal."""
    one = archive(directory)
    one.open()
    one.close()
    return directory


@pytest.fixture
def kept(tmp_path) -> Path:
    return used(tmp_path / "data")


FOLDER = "It must be a folder that this user may write to.*--data-dir"


@pytest.mark.parametrize("place", ["file", "file/data", "link"])
def test_what_is_no_folder(tmp_path, place) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "disk that is away")
    refused(tmp_path / place, f"there is a file, or a link to nothing.*{FOLDER}")
    assert (tmp_path / "file").read_text() == "mine"


def test_a_name_that_no_folder_can_have(tmp_path) -> None:
    refused(tmp_path / ("x" * 300), f"too long.*{FOLDER}")
    refused(Path(f"{tmp_path}/a\0b"), f"null byte.*{FOLDER}")


def test_a_folder_that_is_not_ours(in_sight) -> None:
    folder = in_sight / "theirs"
    folder.mkdir()
    folder.chmod(0o555)
    with as_nobody():
        refused(folder, f"Permission denied.*{FOLDER}")
        refused(folder / "data", f"Permission denied.*{FOLDER}")
    folder.chmod(0o755)
    assert list(folder.iterdir()) == []


def test_a_journal_that_may_only_be_read(in_sight) -> None:
    kept = used(in_sight / "data")
    kept.chmod(0o777)
    (kept / "lock").chmod(0o666)
    (kept / "journal.sqlite").chmod(0o444)
    with as_nobody():
        refused(kept, "cannot be opened: this user may not write to it")


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a disk, which takes root")
def test_a_disk_that_may_only_be_read(tmp_path, kept) -> None:
    def mount(*command: str) -> None:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"cannot mount: {done.stderr}")

    mount("mount", "--bind", str(kept), str(kept))
    try:
        mount("mount", "-o", "remount,bind,ro", str(kept))
        refused(kept, f"Read-only file system.*{FOLDER}")
        refused(kept / "new", f"Read-only file system.*{FOLDER}")
    finally:
        mount("umount", str(kept))


def test_a_link_to_a_journal_that_is_away_is_no_new_journal(kept) -> None:
    journal = kept / "journal.sqlite"
    journal.unlink()
    journal.symlink_to("/nowhere/journal.sqlite")
    refused(kept, "cannot be opened.*on a disk that is there")
    assert journal.is_symlink()


def test_a_folder_in_place_of_the_journal(kept) -> None:
    (kept / "journal.sqlite").unlink()
    (kept / "journal.sqlite").mkdir()
    refused(kept, "it must be a file that this user may read and write")


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        ("PRAGMA user_version = 9", "has format 9; this gpom reads 1 to 2: use another"),
        ("PRAGMA application_id = 9", "is no journal of gpom; move it away or name another"),
    ],
)
def test_a_journal_of_another_program_or_time(kept, harm, told) -> None:
    db = sqlite3.connect(kept / "journal.sqlite")
    db.execute(harm)
    db.close()
    refused(kept, told)


def test_the_map_of_another_site(kept) -> None:
    for site in ("gpom/v1/north", "gpom/v1/north", None):
        one = archive(kept, site)
        one.open()
        one.close()
    with pytest.raises(JournalError, match=r"the map of gpom/v1/north.*is gpom/v1/south.*delete"):
        archive(kept, "gpom/v1/south").open()
    (kept / "site").unlink()
    south = archive(kept, "gpom/v1/south")
    south.open()
    south.close()
