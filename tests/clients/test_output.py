"""What cannot be written is refused before the work, and the check leaves nothing behind."""

import os
from pathlib import Path

import pytest

from clients.output import require_file, require_folder, write
from gpom_core.errors import ConfigurationError


def test_a_folder_is_made_and_empty(tmp_path: Path) -> None:
    for _ in range(2):
        require_folder(tmp_path / "a" / "b")
        assert list((tmp_path / "a" / "b").iterdir()) == []


def test_a_folder_that_is_a_file_or_cannot_be_made_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(ConfigurationError, match="file is a file; expected a folder"):
        require_folder(file)
    for folder in (file / "below", Path("/proc/x"), Path("/proc")):
        with pytest.raises(ConfigurationError, match=f"cannot write {folder}: "):
            require_folder(folder)


def test_a_file_that_can_be_written_stays_as_it_is(tmp_path: Path) -> None:
    new, old, link = tmp_path / "new", tmp_path / "old", tmp_path / "link"
    old.write_text("here before")
    link.symlink_to(tmp_path / "not_yet")
    for path in (new, old, link, Path(os.devnull)):
        require_file(path)
    assert old.read_text() == "here before"
    assert sorted(tmp_path.iterdir()) == [link, old]


def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none" / "file", Path("/proc/x")):
        with pytest.raises(ConfigurationError, match=f"cannot write {path}: "):
            require_file(path)
        with pytest.raises(ConfigurationError, match=f"cannot write {path}: "):
            write(path, b"text")
