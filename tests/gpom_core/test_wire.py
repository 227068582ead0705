"""The payload of a scan, byte by byte, and every way in which it may be wrong."""

import math
import struct
import tracemalloc
import zlib

import numpy as np
import pytest

from gpom_core.errors import InvalidScanError
from gpom_core.scan import Pose2D, Scan
from gpom_core.wire import HEADER_LENGTH, decode, encode

SCAN = Scan(
    pose=Pose2D(1.5, -2.25, 0.125),
    ranges_m=np.array([1.0, math.inf, math.nan, -math.inf], dtype=np.float32),
    angle_min_rad=-0.5,
    angle_increment_rad=0.25,
    range_min_m=0.125,
    range_max_m=30.0,
    stamp_ns=-5,
    boot=7,
    seq=9,
    reliable=True,
    time_increment_s=0.0625,
    scan_time_s=0.5,
    pose_covariance=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    intensities=np.array([10.0, 20.0, 30.0, 40.0], dtype=np.float32),
)
PAYLOAD = encode(SCAN)


def patched(offset: int, code: str, *values: float | bytes, header: int = HEADER_LENGTH) -> bytes:
    """Give PAYLOAD with a field overwritten and the CRC made right again."""
    changed = bytearray(PAYLOAD)
    struct.pack_into("<" + code, changed, offset, *values)
    return sealed(changed, header)


def sealed(payload: bytes | bytearray, header: int = HEADER_LENGTH) -> bytes:
    changed = bytearray(payload)
    crc = zlib.crc32(changed[header:], zlib.crc32(changed[:116]))
    struct.pack_into("<I", changed, 116, crc)
    return bytes(changed)


def reason_of(payload: bytes, **options: int) -> str:
    with pytest.raises(InvalidScanError) as caught:
        decode(payload, **options)
    assert str(caught.value)
    return caught.value.reason


def test_every_field_lies_at_its_offset() -> None:
    def at(offset: int, code: str) -> tuple[float | bytes, ...]:
        return struct.unpack_from("<" + code, PAYLOAD, offset)

    assert len(PAYLOAD) == 120 + 4 * 4 + 4 * 4
    assert at(0, "4s") == (b"GPOM",)
    assert at(4, "BB") == (1, 0)
    assert at(6, "H") == (120,)
    assert at(8, "I") == (1,)
    assert at(12, "I") == (4,)
    assert at(16, "QQ") == (7, 9)
    assert at(32, "q") == (-5,)
    assert at(40, "3d") == (1.5, -2.25, 0.125)
    assert at(64, "6f") == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    assert at(88, "2f") == (-0.5, 0.25)
    assert at(96, "f") == (0.0625,)
    assert at(100, "2f") == (0.125, 30.0)
    assert at(108, "f") == (0.5,)
    assert at(112, "I") == (4,)
    assert at(116, "I") == (zlib.crc32(PAYLOAD[:116] + PAYLOAD[120:]),)
    assert PAYLOAD[120:] == SCAN.ranges_m.tobytes() + struct.pack("<4f", 10, 20, 30, 40)


def test_decoding_gives_back_every_field() -> None:
    scan = decode(PAYLOAD)

    for name in ("pose", "angle_min_rad", "angle_increment_rad", "range_min_m", "range_max_m"):
        assert getattr(scan, name) == getattr(SCAN, name)
    for name in ("stamp_ns", "boot", "seq", "reliable", "time_increment_s", "scan_time_s"):
        assert getattr(scan, name) == getattr(SCAN, name)
    assert scan.pose_covariance == SCAN.pose_covariance
    np.testing.assert_array_equal(scan.ranges_m, SCAN.ranges_m)
    assert scan.intensities is not None
    np.testing.assert_array_equal(scan.intensities, [10.0, 20.0, 30.0, 40.0])
    for values in (scan.ranges_m, scan.intensities):
        assert values.dtype == np.float32
        assert not values.flags.writeable


def test_decoding_copies_no_ranges() -> None:
    assert decode(PAYLOAD).ranges_m.base is not None


def test_a_higher_minor_with_a_longer_header_is_read() -> None:
    for extra in (b"\x2a" * 8, b"\x2a" * 3):
        longer = bytearray(PAYLOAD[:120] + extra + PAYLOAD[120:])
        struct.pack_into("<BH", longer, 5, 3, 120 + len(extra))

        scan = decode(sealed(longer, header=120 + len(extra)))

        assert scan.ranges_m.flags.aligned
        np.testing.assert_array_equal(scan.ranges_m, SCAN.ranges_m)


def test_unknown_flags_are_left_to_later_minors() -> None:
    assert decode(patched(8, "I", 0xFFFFFFFE)).reliable is False


@pytest.mark.parametrize("major", [0, 2, 255])
def test_another_major_is_refused(major: int) -> None:
    assert reason_of(patched(4, "B", major)) == "unsupported_version"


@pytest.mark.parametrize("length", range(len(PAYLOAD)))
def test_every_truncation_is_refused(length: int) -> None:
    assert reason_of(PAYLOAD[:length]) == "truncated"


@pytest.mark.parametrize("position", range(len(PAYLOAD)))
def test_every_flipped_byte_is_noticed(position: int) -> None:
    changed = bytearray(PAYLOAD)
    changed[position] ^= 0x40

    assert reason_of(bytes(changed))


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "truncated"),
        (patched(0, "4s", b"MOPG"), "bad_magic"),
        (patched(6, "H", 119), "bad_header_length"),
        (patched(6, "H", 0), "bad_header_length"),
        (patched(6, "H", 65_535), "truncated"),
        (patched(12, "I", 0), "no_beams"),
        (patched(12, "I", 5), "bad_intensity_count"),
        (patched(112, "I", 3), "bad_intensity_count"),
        (patched(112, "I", 0), "trailing_bytes"),
        (PAYLOAD + b"\0", "trailing_bytes"),
        (patched(24, "Q", 0), "bad_sequence"),
        (patched(40, "d", math.nan), "non_finite_pose"),
        (patched(48, "d", 1e8), "pose_out_of_range"),
        (patched(64, "f", math.inf), "bad_covariance"),
        (patched(88, "f", math.nan), "non_finite_angle"),
        (patched(92, "f", math.nan), "non_finite_angle"),
        (patched(92, "f", 0.0), "zero_angle_increment"),
        (patched(96, "f", math.nan), "non_finite_time"),
        (patched(100, "f", -1.0), "bad_range_limits"),
        (patched(104, "f", 0.125), "bad_range_limits"),
        (patched(104, "f", math.inf), "bad_range_limits"),
        (patched(108, "f", math.inf), "non_finite_time"),
        (PAYLOAD[:116] + b"\0\0\0\0" + PAYLOAD[120:], "bad_crc"),
    ],
)
def test_a_malformed_payload_is_refused_with_its_reason(payload: bytes, reason: str) -> None:
    assert reason_of(payload) == reason


def test_the_number_of_beams_is_bounded() -> None:
    assert decode(PAYLOAD, max_beams=4).ranges_m.size == 4
    assert reason_of(PAYLOAD, max_beams=3) == "too_many_beams"
    assert reason_of(patched(12, "I", 0xFFFFFFFF)) == "too_many_beams"


def test_a_count_in_the_header_allocates_nothing() -> None:
    lie = patched(12, "I", 0xFFFFFFFF)
    tracemalloc.start()
    try:
        assert reason_of(lie, max_beams=1 << 32) == "bad_intensity_count"
        assert reason_of(sealed(lie[:112] + bytes(8) + lie[120:]), max_beams=1 << 32) == "truncated"
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak_bytes < 1 << 20


def test_a_reliable_scan_without_a_number_is_not_sent() -> None:
    scan = Scan(Pose2D(0.0, 0.0, 0.0), np.ones(1, np.float32), 0.0, 0.1, 0.0, 9.0, reliable=True)

    with pytest.raises(InvalidScanError) as caught:
        encode(scan)

    assert caught.value.reason == "bad_sequence"
