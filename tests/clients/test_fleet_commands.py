"""`gpom replay` and `gpom simulate` against a stand-in for the map service."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from clients.cli import run
from tests.clients.test_carmen import flaser, write


@pytest.fixture
def log(tmp_path):
    lines = [
        flaser(np.full(180, 1.0 + i / 100), pose=(i, 0, 0), time_s=str(100 + i / 10))
        for i in range(40)
    ]
    return str(write(tmp_path / "drive.log", *lines, "FLASER 3 broken\n"))


def test_replay_sends_the_whole_log(fake_map, log, capsys):
    assert run(["replay", log, "--robot", "r", "--connect", fake_map.endpoint]) == 0
    scans = fake_map.wait(40)
    assert [scan.seq for scan in scans] == list(range(1, 41))
    assert [scan.pose.x_m for scan in scans] == list(range(40))
    shown = capsys.readouterr()
    assert "drive.log: published 40 scans as r in" in shown.out
    assert "left out 1 of 41 scans that cannot be read: 1 truncated" in shown.err


def test_replay_cuts_the_log_and_skips_what_is_held_out(fake_map, log, capsys):
    flags = ["--robot", "r", "--robots", "3", "--skip-held-out", "--sensor", "front"]
    assert run(["replay", log, *flags, "--connect", fake_map.endpoint]) == 0
    fake_map.wait(36)
    parts = [fake_map.scans(f"r-{i}") for i in (1, 2, 3)]
    assert [len(part) for part in parts] == [12, 12, 12]
    places = [scan.pose.x_m for part in parts for scan in part]
    assert places == [i for i in range(40) if i % 10 != 5]
    assert {str(sample.key_expr).rpartition("/")[2] for sample in fake_map.samples} == {"front"}
    shown = capsys.readouterr().out
    assert "3 robots (r-1 … r-3)" in shown
    assert "4 held out" in shown


def test_replay_keeps_a_rate_and_a_speed(fake_map, log, capsys):
    for pace in (["--rate", "100"], ["--speed", "10"]):
        assert run(["replay", log, "--robot", "r", *pace, "--connect", fake_map.endpoint]) == 0
        elapsed_s = float(re.search(r" in ([0-9.]+) s", capsys.readouterr().out)[1])
        assert elapsed_s >= 0.4  # 39 gaps of 10 ms, rounded


def test_replay_treats_ranges_as_asked(fake_map, log):
    flags = ["--robot", "r", "--range-cap-m", "1.2", "--no-return", "free"]
    assert run(["replay", log, *flags, "--connect", fake_map.endpoint]) == 0
    scans = fake_map.wait(40)
    assert np.isposinf(scans[-1].ranges_m).all()
    assert scans[0].range_max_m == pytest.approx(1.2)


def test_replay_loses_nothing_to_a_slow_map(fake_map, log):
    fake_map.delay_s = 0.02
    assert run(["replay", log, "--robot", "r", "--connect", fake_map.endpoint]) == 0
    assert len(fake_map.wait(40)) == 40


def test_replay_says_that_no_map_is_there(silent_map, log, capsys):
    flags = ["--robot", "r", "--wait-s", "0.2", "--connect", silent_map.endpoint]
    assert run(["replay", log, *flags]) == 1
    assert "no map service is alive under the prefix 'gpom/v1/site'" in capsys.readouterr().err


def test_replay_says_that_the_map_left_for_good(fake_map, log, capsys):
    def leave_after_one():
        fake_map.wait(1)
        fake_map.vanish()

    leave = threading.Thread(target=leave_after_one)
    leave.start()
    flags = ["--robot", "r", "--rate", "20", "--wait-s", "0.3", "--connect", fake_map.endpoint]
    assert run(["replay", log, *flags]) == 1
    assert "went away after" in capsys.readouterr().err
    leave.join()


def test_replay_goes_on_when_the_map_comes_back(fake_map, log, capsys):
    def blink():
        fake_map.wait(1)
        fake_map.vanish()
        time.sleep(0.2)
        fake_map.subscribe()
        fake_map.appear()

    gap = threading.Thread(target=blink)
    gap.start()
    flags = ["--robot", "r", "--rate", "40", "--connect", fake_map.endpoint]
    assert run(["replay", log, *flags]) == 0
    gap.join()
    assert [scan.seq for scan in fake_map.scans()] == list(range(1, 41))
    assert "published 40 scans" in capsys.readouterr().out


def test_replay_fails_when_the_map_acknowledges_nothing(fake_map, log, capsys, monkeypatch):
    monkeypatch.setattr("clients.dispatch.DRAIN_TIMEOUT_S", 0.5)
    monkeypatch.setattr("clients.dispatch._DRAIN_POLL_S", 0.1)
    monkeypatch.setattr("clients.publisher.CLOSE_TIMEOUT_S", 0.1)
    fake_map.drop_every = 1
    flags = ["--robot", "r", "--wait-s", "0.2", "--connect", fake_map.endpoint]
    assert run(["replay", log, *flags]) == 1
    assert "has not acknowledged the last scans" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--robot", "a/b"], "the robot name 'a/b' contains '/'"),
        (["--robot", "_map"], "reserved"),
        (["--robot", "r", "--robots", "41"], "40 scans cannot be cut for 41 robots"),
        (["--robot", "r", "--rate", "1", "--speed", "1"], "expected one of them"),
        (["--robot", "r", "--range-cap-m", "-1"], "positive number of metres"),
        (["--robot", "r", "--prefix", "/x"], "prefix"),
    ],
)
def test_replay_refuses_what_cannot_be(log, capsys, flags, message):
    assert run(["replay", log, *flags, "--connect", "tcp/127.0.0.1:9"]) == 2
    assert message in capsys.readouterr().err


def test_simulate_publishes_all_robots_for_the_duration(fake_map, capsys):
    flags = ["--robots", "2", "--rate", "20", "--beams", "90", "--duration", "0.5"]
    assert run(["simulate", *flags, "--connect", fake_map.endpoint]) == 0
    fake_map.wait(20)
    first, second = fake_map.scans("sim-1"), fake_map.scans("sim-2")
    assert [scan.seq for scan in first] == [scan.seq for scan in second] == list(range(1, 11))
    assert first[0].ranges_m.size == 90
    assert first[0].stamp_ns > 1_600_000_000_000_000_000
    assert "published 20 scans as 2 robots (sim-1 … sim-2)" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_simulate_ends_cleanly_on_a_signal(fake_map, number):
    command = [sys.executable, "-m", "clients.cli", "simulate", "--robots", "1", "--beams", "30"]
    with subprocess.Popen(
        [*command, "--connect", fake_map.endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path.cwd())},
    ) as process:
        fake_map.wait(3, timeout_s=30.0)
        process.send_signal(number)
        out, err = process.communicate(timeout=20.0)
    assert process.returncode == 0, err
    assert "stopped by a signal" in out
    assert "Traceback" not in err


def test_simulate_refuses_what_cannot_be(capsys):
    flags = ["--beams", "0", "--connect", "tcp/127.0.0.1:9"]
    assert run(["simulate", *flags]) == 2
    assert "at least 2 beams" in capsys.readouterr().err
