"""Where compiled code is kept, and what is thrown away."""

import ast
import os
from pathlib import Path

import pytest

from gpom_core import jit

ROOT = Path(jit.__file__).parents[1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(jit.config, "CACHE_DIR", str(tmp_path))
    jit.cache_folder.cache_clear()
    yield tmp_path
    jit.cache_folder.cache_clear()


def aged(path):
    path.mkdir()
    os.utime(path, (0.0, 0.0))
    return path


def test_what_older_sources_of_a_module_left_is_removed_and_other_modules_keep_theirs(folder):
    stale, other = aged(folder / "gpom-reach-0"), aged(folder / "gpom-kernels-0")
    assert (folder / jit.cache_folder("gpom_core.reach")).is_dir()
    assert not stale.exists()
    assert other.exists()


def test_the_name_tells_sources_apart(folder):
    names = {jit.cache_folder(f"gpom_core.{name}") for name in ("reach", "kernels")}
    names.add(jit.cache_folder("clients.world"))
    assert len(names) == 3


def test_the_imports_that_are_read_are_those_that_a_parser_finds():
    sources = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): path
        for package in ("gpom_core", "clients")
        for path in (ROOT / package).rglob("*.py")
    }
    assert len(sources) > 80
    for module, path in sources.items():
        wanted = {
            name
            for node in ast.walk(ast.parse(path.read_bytes()))
            if isinstance(node, ast.ImportFrom) and node.module
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
            if name in sources
        }
        assert wanted <= jit._imported(module.removesuffix(".__init__")), module
