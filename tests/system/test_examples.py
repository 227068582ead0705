"""Every script in clients/examples runs against a real service, as its docstring says."""

import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from runpy import run_module

import pytest

from clients.link import SessionSettings
from clients.map_client import MapClient

ROOT = Path(__file__).parents[2]
SCRIPTS = {path.stem for path in (ROOT / "clients/examples").glob("*.py")} - {"__init__"}
EXPECTED = {
    "ask_points": r"\(0, 0\): occupied \d.*\n.*\n\(100, 100\): nobody has looked there",
    "check_path": r"^drive: risk 0\.\d\d at",
    "follow_map": r"map: \{\"map_version\": [1-9]",
    "give_nav2_a_map": r"map\.yaml",
    "send_scans": r"^stored$",
    "clusters_as_geojson": r"[1-9]\d* lines in",
}


@pytest.fixture(scope="module")
def addresses() -> Iterator[tuple[str, str]]:
    """Where a service listens, for HTTP and for zenoh."""
    flags = ("--port", "0", "--zenoh-listen", "tcp/127.0.0.1:0")
    command = (sys.executable, "-m", "clients.cli", "serve", *flags)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http=(\S+) zenoh=(\S+)", process.stdout.readline())
            assert found is not None
            url, endpoint = found.groups()
            run("send_scans", endpoint)
            with MapClient(url) as site:
                site.flush(timeout_s=300.0)  # the very first start compiles
            yield url, endpoint
        finally:
            process.terminate()


def run(script: str, *arguments: str, folder: Path = ROOT) -> str:
    program = (sys.executable, "-W", "error", "-m", f"clients.examples.{script}", *arguments)
    done = subprocess.run(
        program, capture_output=True, text=True, timeout=100, check=False, cwd=folder,
        env={"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_each_example_is_tested() -> None:
    assert EXPECTED.keys() == SCRIPTS


@pytest.mark.timeout(400)
@pytest.mark.parametrize("script", sorted(EXPECTED))
def test_examples_run(script: str, addresses: tuple[str, str], tmp_path: Path) -> None:
    url, endpoint = addresses

    said = run(script, endpoint if script == "send_scans" else url, folder=tmp_path)

    assert re.search(EXPECTED[script], said, flags=re.MULTILINE), said


@pytest.mark.parametrize("script", sorted(EXPECTED))
def test_without_a_service_an_example_says_so_in_one_line(
    script: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = "tcp/127.0.0.1:1" if script == "send_scans" else "http://127.0.0.1:1"
    monkeypatch.setattr(sys, "argv", [script, nowhere])
    quick = partial(SessionSettings, connect_timeout_s=0.1)
    monkeypatch.setattr("clients.publisher.SessionSettings", quick)

    with pytest.raises(SystemExit) as ended:
        run_module(f"clients.examples.{script}", run_name="__main__")

    said = str(ended.value.code)  # Python prints it, and ends with 1
    assert nowhere in said
    assert said.endswith("Is `gpom serve` running there?")
    assert len(said.splitlines()) == 1
