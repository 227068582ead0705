"""Promises about the repository itself: what the README shows works, and files stay small."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
MAX_LINES = 400


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def targets(text: str) -> set[str]:
    return set(re.findall(r"\bmake (?:--\S+ )*([a-z-]+)", text))


def test_every_make_target_in_the_readme_exists() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    exists = set(re.findall(r"^([a-z-]+):", makefile, flags=re.MULTILINE))

    assert {"demo", "test", "check", "bench"} <= targets(README) <= exists


def test_what_runs_before_a_change_lands_is_in_the_readme() -> None:
    assert targets((ROOT / ".ci" / "run").read_text(encoding="utf-8")) <= targets(README)


def test_every_place_in_the_readme_exists() -> None:
    places = re.findall(r"\]\(([^)#:]+)\)", README)

    assert places
    assert [place for place in places if not (ROOT / place).exists()] == []


@pytest.mark.parametrize("block", [b for b in blocks("python") if "MapClient" not in b])
def test_examples_that_need_no_service_run(block: str) -> None:
    program = [sys.executable, "-W", "error", "-c", block]

    done = subprocess.run(program, capture_output=True, text=True, timeout=100, check=False)

    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.parametrize("package", ["gpom_core", "service", "clients", "tests"])
def test_no_file_is_longer_than_it_can_be_read(package: str) -> None:
    def lines(path: Path) -> int:
        return path.read_text(encoding="utf-8").count("\n")

    long = [str(path) for path in (ROOT / package).rglob("*.py") if lines(path) > MAX_LINES]

    assert long == []
