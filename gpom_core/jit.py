"""The one way gpom_core compiles its hot loops.

Compiled code is cached on disk under a name made of all of gpom_core's sources. numba itself looks
only at the file of the outermost function, and would run old code of the others after an update:
with arrays read by address that is not a wrong number but a crash.
"""

import hashlib
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import config, njit

_Function = TypeVar("_Function", bound=Callable[..., object])

_STALE_AFTER_S = 86_400.0


@cache
def cache_folder() -> str | None:
    """Where compiled code is kept, or None where nothing can be written.

    Below NUMBA_CACHE_DIR if that is set, else beside the sources, else in the user's cache.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.relative_to(package).as_posix().encode())
        digest.update(source.read_bytes())
    name = f"gpom-{digest.hexdigest()[:16]}"
    places = [package / "__pycache__", Path("~/.cache/gpom").expanduser()]
    for place in [Path(config.CACHE_DIR)] if config.CACHE_DIR else places:
        try:
            (place / name).mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=place / name):
                _drop_stale(place, name)
            return str(place / name)
        except OSError:
            continue
    return None


def _drop_stale(folder: Path, name: str) -> None:
    """Remove what other versions of the sources left here more than a day ago."""
    for other in folder.glob("gpom-*"):
        if other.name != name and time.time() - other.stat().st_mtime > _STALE_AFTER_S:
            shutil.rmtree(other, ignore_errors=True)


def _compile(function: _Function, **options: Any) -> _Function:
    folder = cache_folder()
    options |= {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
    before = config.CACHE_DIR
    config.CACHE_DIR = folder or before  # read while decorating; others' functions keep theirs
    try:
        return cast("_Function", njit(cache=folder is not None, **options)(function))
    finally:
        config.CACHE_DIR = before


def compiled(function: _Function) -> _Function:
    """Compile `function` with numba on first call: no interpreter lock held, cached on disk.

    Division by zero follows IEEE 754, and products may be fused with sums (never reordered), so
    the stated error bounds hold.
    """
    return _compile(function)


def vectorised(function: _Function) -> _Function:
    """As `compiled`, and inlined by LLVM wherever it is called, so that loops over it vectorise."""
    return _compile(function, forceinline=True)


def inlined(function: _Function) -> _Function:
    """As `compiled`, and copied into its callers by numba.

    Calls that pass many arrays pay for counting references to each, which in the innermost loop
    over cells costs more than the work.
    """
    return _compile(function, inline="always")
