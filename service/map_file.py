"""A whole map as one file: a zip of a manifest and plain arrays, for checkpoints and export.

Files may come from anywhere. Nothing is unpacked to a path, only known names are read, sizes are
held against the limit before memory is taken, nothing is unpickled, and `gpom_core.image` checks
what the arrays say.
"""

import io
import os
import uuid
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from gpom_core.config import MapConfig
from gpom_core.image import NAMES
from service.errors import MapFileError
from service.npy import read_header

FORMAT = 1
_MANIFEST = "manifest.json"
_MANIFEST_BYTES_MAX = 2**20
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the same map gives the same file


class Manifest(BaseModel):
    """What a map file says about itself."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["gpom-map"] = "gpom-map"
    format: int = FORMAT
    saved_unix_s: float
    journal: str
    position: int
    map: dict[str, Any]


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map at rest.

    Attributes:
        image: see `gpom_core.image`.
        config: with which the map was made.
        journal: identity of the journal whose scans it holds.
        position: of the last of these scans.
        saved_unix_s: when.
    """

    image: Mapping[str, NDArray[np.generic]]
    config: MapConfig
    journal: str
    position: int
    saved_unix_s: float


def write_map(path: Path, saved: SavedMap, *, compress: bool) -> None:
    """Write a map file; it appears under its name when it is complete and durable.

    Raises:
        MapFileError: it cannot be written.
    """
    manifest = Manifest(
        saved_unix_s=saved.saved_unix_s,
        journal=saved.journal,
        position=saved.position,
        map=saved.config.model_dump(mode="json"),
    )
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex}.new")
    try:
        with draft.open("xb") as file:
            with zipfile.ZipFile(file, "w", method) as archive:
                _add(archive, _MANIFEST, manifest.model_dump_json(indent=1).encode(), method)
                for name in sorted(saved.image):
                    content = io.BytesIO()
                    npy.write_array(content, saved.image[name], allow_pickle=False)
                    _add(archive, f"{name}.npy", content.getbuffer(), method)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
        _sync_directory(path.parent)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise MapFileError(f"cannot write {path}: {error.strerror or error}") from error


def read_map(path: Path, bytes_max: int) -> SavedMap:
    """Read a map file.

    Args:
        path: of the file.
        bytes_max: it may not unpack to more.

    Raises:
        MapFileError: unreadable, damaged, too large, or no map file of this format.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = _entries(archive, path, bytes_max)
            text = _content(archive, entries.pop(_MANIFEST))
            manifest = _manifest(text, path)
            image = {
                name.removesuffix(".npy"): _array(_content(archive, entry), name, path)
                for name, entry in entries.items()
            }
    except OSError as error:
        raise MapFileError(f"cannot read {path}: {error.strerror or error}") from error
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        # zlib.error is none of these on its own, but ZipFile wraps what deflate says in BadZipFile.
        raise MapFileError(f"{path} is damaged or no map file: {error}") from error
    try:
        config = MapConfig(**manifest.map)
    except ValidationError as error:
        message = f"{path} has settings of the map that this gpom does not have: {error}"
        raise MapFileError(message) from error
    return SavedMap(image, config, manifest.journal, manifest.position, manifest.saved_unix_s)


def _add(archive: zipfile.ZipFile, name: str, content: bytes | memoryview, method: int) -> None:
    entry = zipfile.ZipInfo(name, _EPOCH)
    entry.compress_type = method
    archive.writestr(entry, content)


def _entries(archive: zipfile.ZipFile, path: Path, bytes_max: int) -> dict[str, zipfile.ZipInfo]:
    expected = {_MANIFEST, *(f"{name}.npy" for name in NAMES)}
    names = [entry.filename for entry in archive.infolist()]
    if len(names) != len(set(names)) or set(names) != expected:
        strange = sorted(set(names) ^ expected)[:5]
        message = f"{path} is no map file: {strange} in it are missing, repeated or unknown"
        raise MapFileError(message)
    size = sum(entry.file_size for entry in archive.infolist())
    if size > bytes_max:
        message = (
            f"{path} unpacks to {size} bytes; at most {bytes_max} are allowed "
            "(setting journal.map_bytes_max)"
        )
        raise MapFileError(message)
    entries = {entry.filename: entry for entry in archive.infolist()}
    if entries[_MANIFEST].file_size > _MANIFEST_BYTES_MAX:
        raise MapFileError(f"{path} is no map file: its manifest is too large")
    return entries


def _content(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    try:
        with archive.open(entry) as file:
            content = file.read(entry.file_size + 1)  # to the end, where the checksum is compared
    except Exception as error:
        if type(error).__module__ == "zlib":
            raise zipfile.BadZipFile(str(error)) from error
        raise
    if len(content) != entry.file_size:
        raise zipfile.BadZipFile(f"{entry.filename} is not as long as it says")
    return content


def _manifest(text: bytes, path: Path) -> Manifest:
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        raise MapFileError(f"{path} has a manifest that is not understood: {error}") from error
    if manifest.format != FORMAT:
        message = f"{path} has format {manifest.format}; this gpom reads {FORMAT}: use another"
        raise MapFileError(message)
    return manifest


def _array(content: bytes, name: str, path: Path) -> NDArray[np.generic]:
    file = io.BytesIO(content)
    try:
        shape, fortran, dtype = read_header(file, bytes_max=1000)
    except ValueError as error:
        raise MapFileError(f"{path} is damaged or no map file: {name}: {error}") from error
    start = file.tell()
    # Not numpy's own reader: it takes memory for what the header says before it reads.
    if dtype.hasobject or fortran or prod(shape) * dtype.itemsize != len(content) - start:
        raise MapFileError(f"{path}: {name} is {dtype} {shape}, which does not fit its size")
    # A copy, for compiled code is compiled once more for arrays that are read only.
    return np.frombuffer(content, dtype, offset=start).reshape(shape).copy()


def _sync_directory(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
