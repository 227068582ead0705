"""The README's first five minutes, typed as they stand there; only addresses are added."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from clients.carmen import CarmenLog
from clients.logs import ReadOptions
from clients.map_client import MapClient

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CHAPTER = README.partition("## First five minutes")[2].partition("\n## ")[0]
COMMANDS = [
    shlex.split(line, comments=True)
    for block in re.findall(r"```sh\n(.*?)```", CHAPTER, flags=re.DOTALL)
    for line in block.splitlines()
]
LOCAL = [command for command in COMMANDS if command[0].startswith(".venv/")]
SERVE, *ASK = LOCAL


def write_log(path: Path) -> None:
    """A robot that drives a metre through a room, as CARMEN writes it."""
    lines = []
    for step in range(12):
        angles = np.deg2rad(np.arange(180) - 89.5)
        along = np.column_stack((np.cos(angles), np.sin(angles)))
        position = np.array([0.1 * step, 0.0])
        ranges = np.min((np.sign(along) * 4.0 - position) / along, axis=1)
        pose = f"{position[0]} 0 0 {position[0]} 0 0"
        readings = " ".join(f"{r:.2f}" for r in ranges)
        lines.append(f"FLASER 180 {readings} {pose} {step}.0 host {step}.0\n")
    path.write_text("# CARMEN Logfile\n" + "".join(lines))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("newcomer")
    write_log(folder / "my-building.log")
    return folder


@pytest.fixture(scope="module")
def addresses(folder: Path) -> Iterator[tuple[str, str]]:
    flags = ("--port", "0", "--zenoh-listen", "tcp/127.0.0.1:0")
    with subprocess.Popen(
        (*here(SERVE), *flags), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        cwd=folder,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            found = re.search(r"http=(\S+) zenoh=(\S+)", process.stdout.readline())
            assert found is not None
            yield found[1], found[2]
        finally:
            process.terminate()
            assert process.wait(60) == 0


def here(command: list[str]) -> tuple[str, ...]:
    """The command in this very environment."""
    program, *arguments = command
    if program == ".venv/bin/gpom":
        return (sys.executable, "-m", "clients.cli", *arguments)
    assert program == ".venv/bin/python"
    return (sys.executable, *arguments)


def addressed(command: list[str], url: str, endpoint: str) -> tuple[str, ...]:
    what = command[1] if command[0].endswith("gpom") else command[2]
    where = {
        "replay": ("--connect", endpoint),
        "query": ("--url", url),
        "export": ("--url", url),
        "clients.examples.send_scans": (endpoint,),
    }
    return (*here(command), *where.get(what, (url,)))


def test_the_chapter_leads_all_the_way() -> None:
    assert SERVE[:2] == [".venv/bin/gpom", "serve"]
    assert {command[1] for command in ASK} >= {"replay", "query", "export", "-m"}
    assert COMMANDS[-1][:2] == ["docker", "compose"]


def test_the_compose_command_is_what_the_container_test_runs() -> None:
    _, _, *arguments = COMMANDS[-1]
    script = (ROOT / "tests/containers/run.sh").read_text(encoding="utf-8")

    assert arguments == ["-f", "docker/compose.yaml", "--profile", "demo", "up", "--build"]
    assert "docker-compose -f docker/compose.yaml --profile demo" in script


@pytest.mark.timeout(400)
def test_every_command_works_in_the_order_of_the_chapter(
    folder: Path, addresses: tuple[str, str]
) -> None:
    assert len(CarmenLog(folder / "my-building.log", ReadOptions()).scans) == 12
    for command in ASK:
        done = subprocess.run(
            addressed(command, *addresses), capture_output=True, text=True, timeout=100,
            check=False, cwd=folder, env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        )  # fmt: skip
        assert done.returncode == 0, (command, done.stdout, done.stderr)
        if "replay" in command:
            with MapClient(addresses[0]) as site:
                site.flush(timeout_s=300.0)  # the very first start compiles
    assert (folder / "my-building.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "my-building.zip").exists()
