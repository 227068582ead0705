"""The one way hot loops are compiled.

Compiled code is cached on disk under a name made of the sources that it was compiled from: those of
its module and of all that this imports. numba itself looks only at the file of the outermost
function, and would run old code of the others after an update: with arrays read by address that is
not a wrong number but a crash.
"""

import hashlib
import re
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
_PACKAGE = Path(__file__).parent
_OURS = ("gpom_core", "clients")  # sources whose changes are noticed
# Not a parse: that of all modules would be a tenth of what a service takes to start.
_IMPORT = re.compile(
    rf"^\s*from\s+(?P<module>(?:{'|'.join(_OURS)})(?:\.\w+)*)\s+import\s+"
    r"(?:\((?P<several>[^)]*)\)|(?P<line>.*))",
    re.MULTILINE,
)


@cache
def _imported(module: str) -> frozenset[str]:
    """Modules of ours that `module` imports, by its source; one too many does no harm."""
    found: set[str] = set()
    for match in _IMPORT.finditer(_source(module).read_text()):
        names = re.findall(r"\w+", match["several"] or match["line"])
        found |= {match["module"], *(f"{match['module']}.{name}" for name in names)}
    return frozenset(name for name in found if _source(name).exists())


@cache
def _source(module: str) -> Path:
    path = _PACKAGE.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def cache_folder(module: str) -> str | None:
    """Where the compiled code of `module` is kept, or None where nothing can be written.

    Below NUMBA_CACHE_DIR if that is set, else beside the sources, else in the user's cache.
    """
    closure, waiting = set(), {module}
    while waiting:
        closure |= waiting
        waiting = set().union(*(_imported(name) for name in waiting)) - closure
    digest = hashlib.sha256()
    for name in sorted(closure):
        digest.update(name.encode())
        digest.update(_source(name).read_bytes())
    name = f"gpom-{module.rpartition('.')[2]}-{digest.hexdigest()[:16]}"
    places = [_PACKAGE / "__pycache__", Path("~/.cache/gpom").expanduser()]
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
    """Remove what other versions of a module's sources left here more than a day ago."""
    for other in folder.glob(f"{name.rpartition('-')[0]}-*"):
        if other.name != name and time.time() - other.stat().st_mtime > _STALE_AFTER_S:
            shutil.rmtree(other, ignore_errors=True)


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] in _OURS


def _compile(function: _Function, **options: Any) -> _Function:
    folder = cache_folder(function.__module__) if _is_ours(function.__module__) else None
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}} | options
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


def brief(function: _Function) -> _Function:
    """As `compiled`, but keeps the interpreter lock: for what takes less than to get it back."""
    return _compile(function, nogil=False)


def vectorised(function: _Function) -> _Function:
    """As `compiled`, and inlined by LLVM wherever it is called, so that loops over it vectorise."""
    return _compile(function, forceinline=True)


def inlined(function: _Function) -> _Function:
    """As `compiled`, and copied into its callers by numba.

    Calls that pass many arrays pay for counting references to each, which in the innermost loop
    over cells costs more than the work.
    """
    return _compile(function, inline="always")
