"""The CARMEN reader against hand-made logs, and against the real ones when they are there."""

import gzip
import os
from math import pi
from pathlib import Path

import numpy as np
import pytest

from clients.carmen import CarmenLog, find_ceiling
from clients.errors import LogReadError
from clients.logs import NoReturns, ReadOptions, is_held_out, open_log
from gpom_core.errors import ConfigurationError

HEADER = "# CARMEN Logfile\nPARAM robot_use_laser on nohost 0\nODOM 0 0 0 0 0 0 0.1 host 0.1\n"


def flaser(readings, *, pose=(1.5, -2.0, 0.5), time_s="12.25", logger_time_s="13.5"):
    values = [len(readings), *readings, *pose, 9.0, 9.0, 9.0, time_s, "host", logger_time_s]
    return "FLASER " + " ".join(map(str, values)) + "\n"


def write(path: Path, *lines: str) -> Path:
    path.write_text(HEADER + "".join(lines))
    return path


def realistic(beams=180, no_returns=12, ceiling=81.83):
    readings = np.round(np.linspace(1.0, 9.0, beams), 2)
    readings[:no_returns] = ceiling
    return readings


def test_takes_pose_stamp_and_angles_from_the_line(tmp_path):
    log = CarmenLog(write(tmp_path / "a.log", flaser(realistic())))
    (scan,) = log.scans
    assert scan.pose == (1.5, -2.0, 0.5)
    assert scan.stamp_ns == 12_250_000_000
    assert scan.angle_min_rad == pytest.approx(-pi / 2)
    assert scan.ranges_m[20] == pytest.approx(realistic()[20])


@pytest.mark.parametrize(
    ("beams", "step_deg"), [(180, 1.0), (181, 1.0), (360, 0.5), (361, 0.5), (90, 2.0)]
)
def test_spreads_the_beams_over_180_degrees(tmp_path, beams, step_deg):
    log = CarmenLog(write(tmp_path / "a.log", flaser(np.full(beams, 2.0))))
    assert np.rad2deg(log.scans[0].angle_increment_rad) == pytest.approx(step_deg)


def test_ipc_time_of_zero_falls_back_to_logger_time(tmp_path):
    log = CarmenLog(write(tmp_path / "a.log", flaser([1.0, 2.0], time_s="0")))
    assert log.scans[0].stamp_ns == 13_500_000_000


@pytest.mark.parametrize("name", ["a.log", "a.log.gz", "misnamed.log"])
def test_tells_gzip_by_content(tmp_path, name):
    path = tmp_path / name
    data = (HEADER + flaser([1.0, 2.0])).encode()
    path.write_bytes(data if name == "a.log" else gzip.compress(data))
    assert len(open_log(path)) == 1


def test_no_returns_are_unknown_by_default_and_empty_on_request(tmp_path):
    path = write(tmp_path / "a.log", flaser(realistic()))
    by_default = CarmenLog(path).scans[0]
    assert np.isnan(by_default.ranges_m[:12]).all()
    assert by_default.hits().sum() == 168
    free = CarmenLog(path, ReadOptions(no_returns=NoReturns.FREE)).scans[0]
    assert free.no_returns().sum() == 12
    assert free.range_max_m == 81.0


@pytest.mark.parametrize(("no_returns", "value"), [("ignore", np.nan), ("free", np.inf)])
def test_a_range_beyond_the_cap_is_a_no_return(tmp_path, no_returns, value):
    path = write(tmp_path / "a.log", flaser([3.0, 19.99, 20.0, 20.01, 25.0]))
    options = ReadOptions(range_cap_m=20.0, no_returns=NoReturns(no_returns))
    scan = CarmenLog(path, options).scans[0]
    np.testing.assert_array_equal(
        scan.ranges_m, np.array([3.0, 19.99, 20.0, value, value], np.float32)
    )
    assert scan.range_max_m == 20.0


def test_a_given_ceiling_wins_over_the_found_one(tmp_path):
    path = write(tmp_path / "a.log", flaser(realistic()))
    scan = CarmenLog(path, ReadOptions(range_ceiling_m=5.0)).scans[0]
    assert np.nanmax(scan.ranges_m) < 5.0


def test_without_a_ceiling_every_reading_is_an_echo(tmp_path):
    scan = CarmenLog(write(tmp_path / "a.log", flaser([3.0, 7.5, 0.0, -1.0]))).scans[0]
    assert scan.range_max_m == 7.5
    np.testing.assert_array_equal(scan.hits(), [True, True, False, False])


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_refuses_impossible_limits(value):
    with pytest.raises(ConfigurationError, match="range_cap_m"):
        ReadOptions(range_cap_m=value)


def test_finds_the_ceiling_of_a_log():
    smooth = np.round(np.linspace(0.5, 30.0, 2000), 2)
    assert find_ceiling(smooth) is None
    assert find_ceiling(np.append(smooth, [81.91, 81.83])) == 81.0
    assert find_ceiling(np.append(smooth, [50.0] * 20)) == 50.0
    assert find_ceiling(np.append(smooth, [50.0] * 3)) is None
    assert find_ceiling(np.full(4, np.nan)) is None


def test_counts_lines_it_cannot_read(tmp_path):
    good = flaser([1.0, 2.0])
    log = CarmenLog(
        write(
            tmp_path / "a.log",
            good,
            good[: len(good) // 2] + "\n",
            "FLASER\n",
            "FLASER many 1 2\n",
            "FLASER -4 1 2\n",
            good.replace("\n", " 4\n"),
            flaser([1.0, "oops"]),
            flaser([1.0, 2.0], pose=("nan", 0, 0)),
            flaser([1.0, 2.0], pose=(1e12, 0, 0)),
            flaser([1.0, 2.0], time_s="inf"),
            good,
        )
    )
    assert len(log) == 2
    assert log.describe().skipped == {
        "truncated": 1,
        "no number of beams": 2,
        "impossible number of beams": 1,
        "too many fields": 1,
        "not a number": 1,
        "pose is not finite": 1,
        "pose_out_of_range": 1,
        "time is not finite": 1,
    }


def test_says_what_it_found_instead_of_scans(tmp_path):
    with pytest.raises(LogReadError, match=r"no FLASER lines.*ODOM"):
        CarmenLog(write(tmp_path / "a.log"))
    (tmp_path / "empty.log").touch()
    with pytest.raises(LogReadError, match="it is empty"):
        CarmenLog(tmp_path / "empty.log")
    with pytest.raises(LogReadError, match=r"none of the FLASER lines.*truncated"):
        CarmenLog(write(tmp_path / "b.log", "FLASER 3 1 2\n"))
    (tmp_path / "c.npz").write_bytes(b"PK\x03\x04\x00\xff\xfe\n\x00\x01 2\n")
    with pytest.raises(LogReadError, match="or a ROS bag, and this is no text at all"):
        CarmenLog(tmp_path / "c.npz")


def test_damaged_gzip_is_a_clear_error(tmp_path):
    whole = gzip.compress((HEADER + flaser(realistic()) * 300).encode())
    (tmp_path / "cut.log.gz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LogReadError, match="damaged"):
        CarmenLog(tmp_path / "cut.log.gz")
    flipped = bytearray(whole)
    flipped[len(flipped) // 2] ^= 0xFF
    (tmp_path / "flipped.log.gz").write_bytes(flipped)
    with pytest.raises(LogReadError, match="damaged"):
        CarmenLog(tmp_path / "flipped.log.gz")


def test_missing_file_and_folder_are_clear_errors(tmp_path):
    with pytest.raises(LogReadError, match="No such file"):
        CarmenLog(tmp_path / "none.log")
    with pytest.raises(LogReadError, match="directory"):
        CarmenLog(tmp_path)


def test_describes_the_log(tmp_path):
    log = CarmenLog(
        write(
            tmp_path / "a.log",
            flaser(realistic(), pose=(0, 0, 0), time_s="10"),
            flaser(realistic(), pose=(3, -4, 0), time_s="12.5"),
        )
    )
    summary = log.describe()
    assert (summary.scans, summary.beams, summary.duration_s) == (2, 180, 2.5)
    assert summary.bounds_m == (0.0, -4.0, 3.0, 0.0)
    assert summary.no_return_share == pytest.approx(12 / 180)
    assert list(log) == log.scans


def test_every_tenth_scan_is_held_out():
    assert [i for i in range(30) if is_held_out(i)] == [5, 15, 25]


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "scans", "beams", "ceiling_m", "no_return_share"),
    [
        ("intel", 910, 180, 81.0, 0.025),
        ("fr079", 4791, 360, 81.0, 0.021),
        ("fr101", 292, 360, 81.0, 0.12),
        ("aces", 440, 180, 50.0, 0.008),
    ],
)
def test_reads_real_logs(name, scans, beams, ceiling_m, no_return_share):
    folder = os.environ.get("GPOM_DATA")
    if not folder:
        pytest.skip("GPOM_DATA is not set: no real logs here")
    summary = CarmenLog(Path(folder) / f"{name}.corrected.log.gz").describe()
    assert (summary.scans, summary.beams) == (scans, beams)
    assert summary.range_ceiling_m == ceiling_m
    assert summary.no_return_share == pytest.approx(no_return_share, abs=0.005)
    assert not summary.skipped
