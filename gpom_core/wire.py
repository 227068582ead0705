"""Scans as bytes, little endian: a header, n float32 ranges, then m float32 intensities.

======  ==================================  ======  ==================================
offset  field                               offset  field
======  ==================================  ======  ==================================
0       magic ``GPOM``                      64      pose covariance xx xy xa yy ya aa
4       major u8 = 1                        88      angle_min f32 rad
5       minor u8 = 0                        92      angle_increment f32 rad
6       header length u16 = 120             96      time_increment f32 s
8       flags u32: bit 0 reliable           100     range_min f32 m
12      n beams u32                         104     range_max f32 m
16      boot u64                            108     scan_time f32 s
24      seq u64                             112     m intensities u32, 0 or n
32      stamp i64 ns                        116     CRC-32 of bytes 0-115 and of all
40      sensor pose x y yaw, 3 x f64                after the header
======  ==================================  ======  ==================================

A higher major is refused. A higher minor only appends header fields, which are skipped.
"""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import InvalidScanError
from gpom_core.scan import Pose2D, Scan

MAGIC = b"GPOM"
MAJOR = 1
MINOR = 0
HEADER_LENGTH = 120
DEFAULT_MAX_BEAMS = 65_536
ENCODING = "application/x-gpom-scan;v=1"

_HEADER = struct.Struct("<4sBBHIIQQqddd6fffffffII")
_PREFIX = struct.Struct("<4sBBHIIQQ")
_CRC = struct.Struct("<I")
_SEQUENCE = struct.Struct("<QQ")
_SEQUENCE_OFFSET = 16
_COUNT = struct.Struct("<I")
_COUNT_OFFSET = 112
_CRC_OFFSET = 116
_RELIABLE = 1 << 0
_VALUE_BYTES = 4


def encode(scan: Scan) -> bytes:
    """Give the payload of a scan; angles, limits, times and covariance are rounded to float32.

    Raises:
        InvalidScanError: the scan is reliable but has no sequence number (``bad_sequence``).
    """
    _check_sequence(scan.reliable, scan.seq)
    intensities = scan.intensities
    header = _HEADER.pack(
        MAGIC,
        MAJOR,
        MINOR,
        HEADER_LENGTH,
        _RELIABLE if scan.reliable else 0,
        scan.ranges_m.size,
        scan.boot,
        scan.seq,
        scan.stamp_ns,
        *scan.pose,
        *scan.pose_covariance,
        scan.angle_min_rad,
        scan.angle_increment_rad,
        scan.time_increment_s,
        scan.range_min_m,
        scan.range_max_m,
        scan.scan_time_s,
        0 if intensities is None else intensities.size,
        0,
    )[:_CRC_OFFSET]
    body = _to_bytes(scan.ranges_m)
    if intensities is not None:
        body += _to_bytes(intensities)
    return header + _CRC.pack(zlib.crc32(body, zlib.crc32(header))) + body


def decode(payload: bytes, *, max_beams: int = DEFAULT_MAX_BEAMS) -> Scan:
    """Read a payload; the arrays of the scan are read-only views of it.

    Nothing is allocated from a length in the header before that length has been held against
    the size of the payload.

    Args:
        payload: the bytes as received.
        max_beams: more beams than this are refused.

    Raises:
        InvalidScanError: malformed, corrupt or of another version; ``reason`` says which.
    """
    body_start, beams, intensities = _check_frame(payload, max_beams)
    fields = _HEADER.unpack_from(payload)
    flags, boot, seq, stamp_ns = fields[4], *fields[6:9]
    angle_min, angle_increment, time_increment, range_min, range_max, scan_time = fields[18:24]
    reliable = bool(flags & _RELIABLE)
    _check_sequence(reliable, seq)
    return Scan(
        pose=Pose2D(*fields[9:12]),
        ranges_m=_view(payload, body_start, beams),
        angle_min_rad=angle_min,
        angle_increment_rad=angle_increment,
        range_min_m=range_min,
        range_max_m=range_max,
        stamp_ns=stamp_ns,
        boot=boot,
        seq=seq,
        reliable=reliable,
        time_increment_s=time_increment,
        scan_time_s=scan_time,
        pose_covariance=fields[12:18],
        intensities=_view(payload, body_start + _VALUE_BYTES * beams, intensities)
        if intensities
        else None,
    )


def renumber(payload: bytes, boot: int, seq: int) -> bytes:
    """Give a payload of `encode` another place in a stream; all else stays.

    For whoever keeps payloads before it is known which number they will have.
    """
    header = bytearray(payload[:HEADER_LENGTH])
    _SEQUENCE.pack_into(header, _SEQUENCE_OFFSET, boot, seq)
    body = memoryview(payload)[HEADER_LENGTH:]
    crc = zlib.crc32(body, zlib.crc32(memoryview(header)[:_CRC_OFFSET]))
    _CRC.pack_into(header, _CRC_OFFSET, crc)
    return bytes(header) + body


def _check_frame(payload: bytes, max_beams: int) -> tuple[int, int, int]:
    """Check all that holds the payload together; give body offset, beams and intensities."""
    if len(payload) < HEADER_LENGTH:
        message = f"{len(payload)} bytes; expected at least the header of {HEADER_LENGTH}"
        raise InvalidScanError("truncated", message)
    magic, major, minor, header_length, _, beams, _, _ = _PREFIX.unpack_from(payload)
    _check_version(magic, major, minor, header_length)
    (intensities,) = _COUNT.unpack_from(payload, _COUNT_OFFSET)
    _check_counts(beams, intensities, max_beams)
    _check_size(len(payload), header_length + _VALUE_BYTES * (beams + intensities))
    _check_crc(payload, header_length)
    return header_length, beams, intensities


def _check_version(magic: bytes, major: int, minor: int, header_length: int) -> None:
    if magic != MAGIC:
        raise InvalidScanError("bad_magic", f"starts with {magic!r}; expected {MAGIC!r}")
    if major != MAJOR:
        message = f"format {major}.{minor}; expected major {MAJOR}: use matching releases of gpom"
        raise InvalidScanError("unsupported_version", message)
    if header_length < HEADER_LENGTH:
        message = f"header length {header_length}; expected at least {HEADER_LENGTH}"
        raise InvalidScanError("bad_header_length", message)


def _check_counts(beams: int, intensities: int, max_beams: int) -> None:
    if beams == 0:
        raise InvalidScanError("no_beams", "the scan has no beams; expected at least one")
    if beams > max_beams:
        message = f"{beams} beams; at most {max_beams} are allowed here"
        raise InvalidScanError("too_many_beams", message)
    if intensities not in (0, beams):
        message = f"{intensities} intensities; expected 0 or one for each of {beams} beams"
        raise InvalidScanError("bad_intensity_count", message)


def _check_size(actual: int, expected: int) -> None:
    if actual < expected:
        message = f"{actual} bytes; expected {expected} from the counts in the header"
        raise InvalidScanError("truncated", message)
    if actual > expected:
        message = f"{actual} bytes; expected {expected} from the counts in the header"
        raise InvalidScanError("trailing_bytes", message)


def _check_crc(payload: bytes, header_length: int) -> None:
    view = memoryview(payload)
    (stated,) = _CRC.unpack_from(payload, _CRC_OFFSET)
    computed = zlib.crc32(view[header_length:], zlib.crc32(view[:_CRC_OFFSET]))
    if computed != stated:
        message = f"CRC-32 {computed:08x} of the content; the header states {stated:08x}"
        raise InvalidScanError("bad_crc", message)


def _check_sequence(reliable: bool, seq: int) -> None:
    if reliable and seq == 0:
        message = "a reliable scan has sequence number 0; its stream is numbered from 1"
        raise InvalidScanError("bad_sequence", message)


def _to_bytes(values: NDArray[np.float32]) -> bytes:
    return values.astype("<f4", copy=False).tobytes()


def _view(payload: bytes, offset: int, count: int) -> NDArray[np.float32]:
    values = np.frombuffer(payload, dtype="<f4", count=count, offset=offset)
    # A longer header may leave the body unaligned; compiled loops want native, aligned numbers.
    result = values.astype(np.float32, copy=not values.flags.aligned)
    result.flags.writeable = False
    return result
