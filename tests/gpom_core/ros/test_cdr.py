import struct
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpom_core.errors import InvalidTransformError, RosMessageError
from gpom_core.ros import cdr
from gpom_core.ros.messages import (
    pose_of,
    read_sweep,
    read_transforms,
    write_grid,
    write_grid_update,
)
from tests.gpom_core.ros import samples
from tests.gpom_core.ros.vectors import HASH, SCAN_BIG, SCAN_LITTLE

HUGE = struct.pack("<I", 0xFFFF_FFFF)


def reason(payload, beams_max=100) -> str:
    with pytest.raises(RosMessageError) as caught:
        read_sweep(payload, beams_max)
    return caught.value.reason


@pytest.mark.parametrize("payload", [SCAN_LITTLE, SCAN_BIG])
def test_reads_a_scan_of_either_byte_order(payload) -> None:
    sweep = read_sweep(payload, 100)
    assert (sweep.frame, sweep.stamp_ns) == ("laser", 1_000_000_002)
    assert np.array_equal(sweep.ranges_m, [0, 1, 2, 3, 4])
    assert sweep.ranges_m.dtype == np.float32
    assert sweep.angle_increment_rad == pytest.approx(0.1)
    assert (sweep.range_min_m, sweep.range_max_m) == pytest.approx((0.1, 10.0))
    assert sweep.intensities is None


@pytest.mark.parametrize("little_endian", [True, False])
def test_reads_transforms(little_endian) -> None:
    message = samples.tf(("map", "/base", (1.0, 2.0, 0.5), 7), ("base", "laser", (3.0, 0, 0), 8))
    found = list(read_transforms(samples.cdr(message, little_endian=little_endian)))
    assert [(item.parent, item.child, item.stamp_ns) for item in found] == [
        ("map", "base", 7),
        ("base", "laser", 8),
    ]
    assert found[0].pose[:3] == (1.0, 2.0, 0.0)


def test_reads_poses() -> None:
    found = pose_of(
        cdr.decode(samples.cdr(samples.odometry(5, 1, 2, 0.5, covariance=1.0)), cdr.ODOMETRY)
    )
    assert (found.frame, found.child, found.stamp_ns) == ("odom", "base", 5)
    assert found.covariance == (0.0, 1.0, 5.0, 7.0, 11.0, 35.0)
    found = pose_of(cdr.decode(samples.cdr(samples.pose(5, 1, 2, 0.5)), cdr.POSE))
    assert (found.frame, found.child) == ("map", "")


def test_a_transform_that_is_none_is_refused() -> None:
    message = samples.tf(("map", "base", (np.nan, 0.0, 0.0), 1))
    with pytest.raises(InvalidTransformError):
        list(read_transforms(samples.cdr(message)))


@pytest.mark.parametrize("length", range(len(SCAN_LITTLE)))
def test_a_truncated_scan_is_refused(length) -> None:
    assert reason(SCAN_LITTLE[:length]) in {"truncated", "bad_cdr"}


def test_lengths_of_four_gigabytes_allocate_nothing() -> None:
    ranges_at = SCAN_LITTLE.index(bytes.fromhex("05000000"))
    frame_at = SCAN_LITTLE.index(bytes.fromhex("06000000"))
    hostile = [
        SCAN_LITTLE[:at] + HUGE + SCAN_LITTLE[at + 4 :]
        for at in (ranges_at, frame_at, len(SCAN_LITTLE) - 4)
    ]
    tf = bytes.fromhex("00010000") + HUGE + bytes(64)
    cdr.types()
    reason(SCAN_LITTLE[:50])  # compiles what reads scans
    tracemalloc.start()
    try:
        assert {reason(payload) for payload in hostile} == {"bad_cdr"}
        with pytest.raises(RosMessageError):
            list(read_transforms(tf))
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        ("0002", "parameter lists"),
        ("0003", "parameter lists"),
        ("0007", "XCDR version 2"),
        ("0009", "delimited"),
        ("000b", "parameter lists"),
        ("0101", "encapsulation 0x0101"),
    ],
)
def test_other_encodings_are_refused_by_name(start, expected) -> None:
    with pytest.raises(RosMessageError, match=expected) as caught:
        read_sweep(bytes.fromhex(start) + SCAN_LITTLE[2:], 100)
    assert caught.value.reason == "unsupported_encoding"


def test_too_much_is_refused() -> None:
    assert reason(SCAN_LITTLE, beams_max=4) == "too_many_beams"
    assert reason(SCAN_LITTLE + bytes(cdr.MESSAGE_BYTES_MAX)) == "too_large"


@given(st.binary(max_size=300), st.booleans())
def test_survives_anything(data, plain) -> None:
    payload = (b"\x00\x01\x00\x00" if plain else b"") + data
    for read in (lambda: read_sweep(payload, 100), lambda: list(read_transforms(payload))):
        with suppress(RosMessageError, InvalidTransformError):
            read()


@given(st.integers(4, len(SCAN_LITTLE) - 1), st.integers(0, 255))
def test_survives_any_byte_changed(at, value) -> None:
    payload = bytearray(SCAN_LITTLE)
    payload[at] = value
    with suppress(RosMessageError):
        read_sweep(bytes(payload), 100)


def test_grids_are_what_ros_reads() -> None:
    cells = np.array([[-1, 0, 100], [50, -1, 7]], np.int8)
    grid = samples.STORE.deserialize_cdr(
        write_grid(cells, (-1.5, 2.0), 0.05, "map", 3_000_000_004), cdr.OCCUPANCY_GRID
    )
    assert (grid.info.width, grid.info.height) == (3, 2)
    assert grid.info.resolution == pytest.approx(0.05)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-1.5, 2.0)
    assert grid.header.frame_id == "map"
    assert (grid.header.stamp.sec, grid.header.stamp.nanosec) == (3, 4)
    assert np.array_equal(grid.data, cells.ravel())
    update = cdr.decode(write_grid_update(cells, 4, 5, "map", 0), cdr.GRID_UPDATE)
    assert (update.x, update.y, update.width, update.height) == (4, 5, 3, 2)
    assert np.array_equal(update.data, cells.ravel())


def test_hashes_and_names_are_those_of_ros() -> None:
    assert cdr.type_hash(cdr.LASER_SCAN) == HASH
    assert cdr.dds_name(cdr.LASER_SCAN) == "sensor_msgs::msg::dds_::LaserScan_"
