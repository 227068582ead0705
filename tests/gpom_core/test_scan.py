"""What a scan accepts, what it refuses, and what its beams mean."""

import math
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from gpom_core.errors import InvalidScanError
from gpom_core.scan import MAX_ABS_POSITION_M, Pose2D, Scan

INF = math.inf
NAN = math.nan


def make_scan(**changes: Any) -> Scan:
    fields: dict[str, Any] = {
        "pose": Pose2D(1.0, 2.0, 0.5),
        "ranges_m": np.array([1.0, 2.0, 3.0], dtype=np.float32),
        "angle_min_rad": -1.0,
        "angle_increment_rad": 0.25,
        "range_min_m": 0.1,
        "range_max_m": 10.0,
    }
    return Scan(**(fields | changes))


def test_ranges_are_classified_as_rep_117() -> None:
    scan = make_scan(ranges_m=[0.1, 10.0, 0.05, 10.5, INF, -INF, NAN, 5.0])

    assert scan.hits().tolist() == [True, True, False, False, False, False, False, True]
    assert scan.no_returns().tolist() == [False] * 4 + [True] + [False] * 3


@pytest.mark.parametrize("limit_m", [0.1, 8.1, 29.9, 81.83])
def test_a_range_at_the_limit_is_a_hit_although_float32_rounds_it(limit_m: float) -> None:
    ranges_m = np.array([limit_m], dtype=np.float32)

    assert make_scan(ranges_m=ranges_m, range_max_m=np.float64(limit_m), range_min_m=0).hits()
    assert make_scan(ranges_m=ranges_m, range_max_m=100.0, range_min_m=np.float64(limit_m)).hits()


def test_beams_turn_with_the_pose_and_against_the_clock() -> None:
    scan = make_scan()

    np.testing.assert_allclose(scan.beam_angles_rad(), [-0.5, -0.25, 0.0])
    assert scan.beam_angles_rad().dtype == np.float64


def test_a_scanner_upside_down_has_a_negative_increment() -> None:
    scan = make_scan(angle_min_rad=1.0, angle_increment_rad=-0.25)

    np.testing.assert_allclose(scan.beam_angles_rad(), [1.5, 1.25, 1.0])


def test_a_scan_of_invalid_ranges_only_is_valid_and_says_nothing() -> None:
    scan = make_scan(ranges_m=np.full(4, NAN))

    assert not scan.hits().any()
    assert not scan.no_returns().any()


def test_one_beam_needs_no_increment() -> None:
    assert make_scan(ranges_m=[1.0], angle_increment_rad=0.0).beam_angles_rad() == [-0.5]


def test_nothing_of_a_scan_can_be_changed() -> None:
    given = np.ones(3, dtype=np.float32)
    scan = make_scan(ranges_m=given, intensities=given)
    given[0] = 7.0

    assert scan.ranges_m[0] == 1.0
    with pytest.raises(FrozenInstanceError):
        scan.seq = 2  # type: ignore[misc]
    for values in (scan.ranges_m, scan.intensities):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 2.0  # type: ignore[index]


def test_fields_are_brought_to_their_types() -> None:
    scan = make_scan(
        pose=(np.float32(1), 2, 3),
        ranges_m=[1, 2],
        range_max_m=np.float32(8),
        seq=np.uint64(5),
        intensities=[1, 2],
    )

    assert scan.pose == Pose2D(1.0, 2.0, 3.0)
    assert isinstance(scan.pose, Pose2D)
    assert scan.ranges_m.dtype == np.float32
    assert scan.intensities is not None
    assert scan.intensities.dtype == np.float32
    assert type(scan.range_max_m) is float
    assert type(scan.seq) is int


def test_a_range_too_large_for_float32_is_invalid_not_free() -> None:
    scan = make_scan(ranges_m=[1e300, INF])

    assert np.isnan(scan.ranges_m[0])
    assert scan.no_returns().tolist() == [False, True]


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32])
def test_a_masked_reading_is_invalid(kind: type) -> None:
    given = np.ma.masked_equal(np.array([1, 9, 3], dtype=kind), 9)
    given.flags.writeable = False
    unmasked = np.ma.masked_array(np.array([1, 9, 3], dtype=kind))
    scan = make_scan(ranges_m=given, intensities=given)

    assert scan.hits().tolist() == [True, False, True]
    assert scan.intensities is not None
    for values in (scan.ranges_m, scan.intensities):
        assert type(values) is np.ndarray
        np.testing.assert_array_equal(values, [1.0, NAN, 3.0])
    np.testing.assert_array_equal(make_scan(ranges_m=unmasked).ranges_m, [1.0, 9.0, 3.0])


def test_a_scan_survives_pickling() -> None:
    scan = pickle.loads(pickle.dumps(make_scan(seq=3)))

    assert scan.seq == 3
    np.testing.assert_array_equal(scan.ranges_m, [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"pose": Pose2D(NAN, 0.0, 0.0)}, "non_finite_pose"),
        ({"pose": Pose2D(0.0, INF, 0.0)}, "non_finite_pose"),
        ({"pose": Pose2D(0.0, 0.0, -INF)}, "non_finite_pose"),
        ({"pose": Pose2D(2 * MAX_ABS_POSITION_M, 0.0, 0.0)}, "pose_out_of_range"),
        ({"pose": Pose2D(0.0, -1e300, 0.0)}, "pose_out_of_range"),
        ({"pose": Pose2D(0.0, 0.0, 1e9)}, "pose_out_of_range"),
        ({"pose": (0.0, 0.0)}, "bad_field"),
        ({"ranges_m": []}, "no_beams"),
        ({"ranges_m": np.ones((2, 2))}, "bad_shape"),
        ({"ranges_m": 1.0}, "bad_shape"),
        ({"ranges_m": ["near", "far"]}, "bad_field"),
        ({"angle_min_rad": NAN}, "non_finite_angle"),
        ({"angle_min_rad": 1e4}, "angle_out_of_range"),
        ({"angle_min_rad": None}, "bad_field"),
        ({"angle_increment_rad": INF}, "non_finite_angle"),
        ({"angle_increment_rad": 1e30}, "angle_out_of_range"),
        ({"angle_increment_rad": 0.0}, "zero_angle_increment"),
        ({"angle_increment_rad": 1e-60}, "zero_angle_increment"),
        ({"range_min_m": -0.1}, "bad_range_limits"),
        ({"range_min_m": NAN}, "bad_range_limits"),
        ({"range_min_m": 10.0}, "bad_range_limits"),
        ({"range_min_m": 10.0 - 1e-12}, "bad_range_limits"),
        ({"range_max_m": INF}, "bad_range_limits"),
        ({"range_max_m": NAN}, "bad_range_limits"),
        ({"range_max_m": 1e30}, "bad_range_limits"),
        ({"range_max_m": 1e300}, "too_large"),
        ({"time_increment_s": NAN}, "non_finite_time"),
        ({"scan_time_s": INF}, "non_finite_time"),
        ({"pose_covariance": (0.0,) * 5}, "bad_covariance"),
        ({"pose_covariance": (0.0,) * 5 + (NAN,)}, "bad_covariance"),
        ({"pose_covariance": (1e300,) + (0.0,) * 5}, "too_large"),
        ({"intensities": [1.0, 2.0]}, "bad_intensity_count"),
        ({"seq": -1}, "bad_sequence"),
        ({"seq": 1 << 48}, "bad_sequence"),
        ({"seq": 1.5}, "bad_field"),
        ({"boot": (1 << 63) - 1}, "bad_sequence"),
        ({"stamp_ns": 1 << 63}, "bad_stamp"),
    ],
)
def test_a_malformed_scan_is_refused_with_its_reason(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(InvalidScanError) as caught:
        make_scan(**changes)

    assert caught.value.reason == reason
    assert str(caught.value)
