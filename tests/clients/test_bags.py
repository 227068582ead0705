import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from typer.testing import CliRunner

from clients.errors import LogReadError
from clients.log_reader import NoReturns, ReadOptions
from clients.logs import open_log
from clients.protocol import read_scans
from tests.clients.ros_bags import drive, write_bag
from tests.gpom_core.ros.samples import S, laser_scan, make, tf

DATA = os.environ.get("GPOM_DATA")
BAGS = Path(DATA or ".") / "bags"
needs_data = pytest.mark.skipif(DATA is None, reason="GPOM_DATA does not name the laser logs")
KINDS = ["intel_corrected.bag", "intel_corrected_db3", "intel_corrected_mcap"]


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_scans_stand_where_the_transforms_say(tmp_path, plugin) -> None:
    path = write_bag(tmp_path / "bag", drive(), plugin)
    (file,) = [file for file in path.iterdir() if file.suffix != ".yaml"]
    for source in (path, file):
        log = open_log(source)
        assert [scan.pose.x_m for scan in log] == pytest.approx([0.5 + n / 5 for n in range(10)])
        assert "scans of /scan, placed by where laser is in map" in log.describe().notes


def test_between_transforms_it_interpolates_and_outside_it_leaves_out(tmp_path) -> None:
    messages = [
        *drive(3),
        ("/scan", 101 * S, laser_scan(100 * S + S // 10)),
        ("/scan", 101 * S, laser_scan(90 * S)),
        ("/scan", 101 * S, laser_scan(110 * S)),
    ]
    log = open_log(write_bag(tmp_path / "bag", messages))
    assert log.describe().skipped == {
        "before the first transform": 1,
        "after the last transform": 1,
    }
    assert list(log)[-1].pose.x_m == pytest.approx(0.6)


def test_motion_within_a_sweep_is_corrected(tmp_path) -> None:
    sweeps = drive(3, ranges=[2.0] * 5, time_increment=0.04, angle_increment=0.5)
    scans = list(open_log(write_bag(tmp_path / "bag", sweeps)))
    assert scans[0].ranges_m[0] == pytest.approx(2.0)
    assert scans[0].ranges_m[-1] > 2.05  # the robot has come 16 cm nearer
    assert scans[0].time_increment_s == 0.0
    assert scans[-1].time_increment_s == pytest.approx(0.04)  # ends after the last transform


def test_no_returns_and_caps(tmp_path) -> None:
    ranges = [1.0, np.inf, 25.0, 40.0, np.nan]
    path = write_bag(tmp_path / "bag", drive(2, ranges=ranges))
    (scan, _) = open_log(path, ReadOptions(NoReturns.FREE, 20.0))
    assert np.array_equal(scan.ranges_m, [1.0, np.inf, np.inf, 40.0, np.nan], equal_nan=True)
    assert scan.range_max_m == 20.0
    (scan, _) = open_log(path)
    assert np.array_equal(scan.ranges_m, [1.0, np.nan, 25.0, 40.0, np.nan], equal_nan=True)
    log = open_log(path, ReadOptions(NoReturns.FREE, None, 30.0))
    assert np.array_equal(
        next(iter(log)).ranges_m, [1.0, np.inf, 25.0, np.inf, np.nan], equal_nan=True
    )
    assert log.describe().no_return_share == pytest.approx(0.4)


def test_several_topics_must_be_chosen_from(tmp_path) -> None:
    messages = [*drive(4), *drive(2, topic="/rear/scan", frame="rear", ranges=[1.0] * 7)]
    path = write_bag(tmp_path / "bag", messages)
    with pytest.raises(
        LogReadError, match=r"/rear/scan \(2\), /scan \(4\); choose one with --topic"
    ):
        open_log(path)
    assert open_log(path, ReadOptions(topic="rear/scan")).describe().beams == 7
    with pytest.raises(LogReadError, match="no laser scans on /front"):
        open_log(path, ReadOptions(topic="/front"))


def test_without_a_map_frame_the_root_is_the_map(tmp_path) -> None:
    messages = [("/tf", S, tf(("odom", "laser", (3, 0, 0), S))), ("/scan", S, laser_scan(S))]
    path = write_bag(tmp_path / "bag", messages)
    log = open_log(path)
    assert "no frame is called map; odom may drift" in log.describe().notes
    for name in ("laser", "/laser"):
        assert open_log(path, ReadOptions(map_frame=name)).scans[0].pose.x_m == 0.0
    with pytest.raises(LogReadError, match="no frame site; it has: laser, odom"):
        open_log(path, ReadOptions(map_frame="site"))


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([("/chat", 1, make("std_msgs/msg/String", data="hi"))], r"no laser scans .* /chat \(std_"),
        ([("/scan", 1, laser_scan(1))], r"has scans \(/scan\) but no transforms"),
        (
            [("/scan", 1, laser_scan(1, "radar")), ("/tf", 1, tf(("map", "base", (0, 0, 0), 1)))],
            "in the frame radar, which no transform leads to; its frames are: base, map",
        ),
        (
            [
                ("/scan", 1, laser_scan(1, "laser")),
                ("/tf", 1, tf(("odom", "laser", (0, 0, 0), 1), ("earth", "map", (0, 0, 0), 1))),
            ],
            r"none of the scans of /scan .* \(1 frames not connected",
        ),
    ],
)
def test_other_content_gets_one_clear_sentence(tmp_path, messages, words) -> None:
    with pytest.raises(LogReadError, match=words) as caught:
        open_log(write_bag(tmp_path / "bag", messages))
    assert "\n" not in str(caught.value)


def test_damaged_and_foreign_files(tmp_path) -> None:
    whole = write_bag(tmp_path / "bag", drive(50))
    (file,) = whole.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:900])
    with pytest.raises(LogReadError, match=r"is damaged: .*mcap recover"):
        open_log(whole)
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogReadError, match="no ROS bag; expected"):
        open_log(tmp_path / "empty")
    renamed = tmp_path / "bag.dat"
    renamed.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(LogReadError, match="rename it"):
        open_log(renamed)
    shutil.copy(renamed, tmp_path / "short.bag")
    with pytest.raises(LogReadError, match="is damaged"):
        open_log(tmp_path / "short.bag")


def test_a_carmen_log_has_no_topics(tmp_path) -> None:
    (tmp_path / "a.log").write_text("FLASER 2 1 1 0 0 0 0 0 0 1 h 1\n")
    with pytest.raises(LogReadError, match="is no ROS bag"):
        open_log(tmp_path / "a.log", ReadOptions(topic="/scan"))


def test_the_command_tells_what_it_chose(tmp_path) -> None:
    from clients.cli import app  # noqa: PLC0415 - the command line, when it is tested

    path = write_bag(tmp_path / "bag", drive(20))
    result = CliRunner().invoke(app, ["evaluate", str(path), "--topic", "/other"])
    assert "no laser scans on /other" in str(result.exception)


@needs_data
@pytest.mark.data
@pytest.mark.parametrize("kind", KINDS)
def test_the_intel_bags_are_the_intel_log(kind) -> None:
    expected = read_scans(BAGS.parent / "intel.corrected.log.gz")
    found = read_scans(BAGS / kind)
    assert len(found) == len(expected) == 910
    for one, other in zip(found, expected, strict=True):
        assert one.pose[:2] == other.pose[:2]
        assert np.cos(one.pose.yaw_rad - other.pose.yaw_rad) == pytest.approx(1.0, abs=1e-12)
        assert np.array_equal(one.ranges_m, other.ranges_m, equal_nan=True)
        assert one.range_max_m == other.range_max_m


@needs_data
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("leg_tracker_stationary_genuine.bag", "no transforms"),
        ("scan_tools_demo_ORIGINAL_bad_index.bag", r"is damaged: .*\(rosbag reindex\)"),
    ],
)
def test_genuine_bags_that_cannot_be_replayed_say_why(name, words) -> None:
    with pytest.raises(LogReadError, match=words):
        open_log(BAGS / name)
