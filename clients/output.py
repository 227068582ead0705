"""Files and folders that commands write: what cannot be written is refused, and before the work."""

from pathlib import Path
from tempfile import TemporaryFile

from gpom_core.errors import ConfigurationError


def require_folder(folder: Path) -> None:
    """Make a folder, and see that files can be made in it.

    Raises:
        ConfigurationError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except FileExistsError as error:
        message = f"{folder} is a file; expected a folder, or the name of a new one"
        raise ConfigurationError(message) from error
    except OSError as error:
        raise cannot_write(folder, error) from error


def require_file(path: Path) -> None:
    """See that a file can be written, and leave everything as it is.

    Raises:
        ConfigurationError: it cannot.
    """
    there = path.exists()
    if there and not path.is_file() and not path.is_dir():
        return  # a pipe takes what is said once
    try:
        with path.open("ab"):
            pass
        if not there:
            path.resolve().unlink()  # not the link to it
    except OSError as error:
        raise cannot_write(path, error) from error


def write(path: Path, content: bytes) -> None:
    """Write a file.

    Raises:
        ConfigurationError: it cannot be written, with the system's reason.
    """
    try:
        path.write_bytes(content)
    except OSError as error:
        raise cannot_write(path, error) from error


def cannot_write(path: Path, error: OSError) -> ConfigurationError:
    """The error that says so, with the system's reason."""
    return ConfigurationError(f"cannot write {path}: {error.strerror or error}")
