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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import InvalidScanError
from gpom_core.scan import Pose2D, Scan, assemble, check_fields

MAGIC = b"GPOM"
MAJOR = 1
MINOR = 0
HEADER_LENGTH = 120
DEFAULT_MAX_BEAMS = 65_536
ENCODING = "application/x-gpom-scan;v=1"

_HEADER = struct.Struct("<4sBBHIIQQqddd6fffffffII")
_CRC = struct.Struct("<I")
_SEQUENCE = struct.Struct("<QQ")
_SEQUENCE_OFFSET = 16
_CRC_OFFSET = 116
_RELIABLE = 1 << 0
_VALUE_BYTES = 4
_WIRE_FLOAT: np.dtype[np.float32] = np.dtype("<f4")


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
    fields = _check_frame(payload, max_beams)
    body_start, flags, beams, boot, seq, stamp_ns = fields[3:9]
    reliable = bool(flags & _RELIABLE)
    _check_sequence(reliable, seq)
    pose, float32, intensities = Pose2D(*fields[9:12]), fields[12:24], fields[24]
    check_fields(pose, boot, seq, stamp_ns, float32, beams)
    return assemble(
        pose,
        _view(payload, body_start, beams),
        _view(payload, body_start + _VALUE_BYTES * beams, intensities) if intensities else None,
        (stamp_ns, boot, seq, reliable),
        float32,
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


def _check_frame(payload: bytes, max_beams: int) -> tuple[Any, ...]:
    """Check all that holds the payload together; give the fields of the header."""
    size = len(payload)
    if size < HEADER_LENGTH:
        message = f"{size} bytes; expected at least the header of {HEADER_LENGTH}"
        raise InvalidScanError("truncated", message)
    fields = _HEADER.unpack_from(payload)
    magic, major, minor, header_length, _, beams = fields[:6]
    intensities, stated = fields[24:]
    if not (magic == MAGIC and major == MAJOR and header_length >= HEADER_LENGTH):
        raise _bad_version(magic, major, minor, header_length)
    if not (0 < beams <= max_beams and intensities in (0, beams)):
        raise _bad_counts(beams, intensities, max_beams)
    expected = header_length + _VALUE_BYTES * (beams + intensities)
    if size != expected:
        message = f"{size} bytes; expected {expected} from the counts in the header"
        raise InvalidScanError("truncated" if size < expected else "trailing_bytes", message)
    view = memoryview(payload)
    computed = zlib.crc32(view[header_length:], zlib.crc32(view[:_CRC_OFFSET]))
    if computed != stated:
        message = f"CRC-32 {computed:08x} of the content; the header states {stated:08x}"
        raise InvalidScanError("bad_crc", message)
    return fields


def _bad_version(magic: bytes, major: int, minor: int, header_length: int) -> InvalidScanError:
    if magic != MAGIC:
        return InvalidScanError("bad_magic", f"starts with {magic!r}; expected {MAGIC!r}")
    if major != MAJOR:
        message = f"format {major}.{minor}; expected major {MAJOR}: use matching releases of gpom"
        return InvalidScanError("unsupported_version", message)
    message = f"header length {header_length}; expected at least {HEADER_LENGTH}"
    return InvalidScanError("bad_header_length", message)


def _bad_counts(beams: int, intensities: int, max_beams: int) -> InvalidScanError:
    if beams == 0:
        message = "the scan has no beams; expected at least one"
        return InvalidScanError("no_beams", message)
    if beams > max_beams:
        message = f"{beams} beams; at most {max_beams} are allowed here"
        return InvalidScanError("too_many_beams", message)
    message = f"{intensities} intensities; expected 0 or one for each of {beams} beams"
    return InvalidScanError("bad_intensity_count", message)


def _check_sequence(reliable: bool, seq: int) -> None:
    if reliable and seq == 0:
        message = "a reliable scan has sequence number 0; its stream is numbered from 1"
        raise InvalidScanError("bad_sequence", message)


def _to_bytes(values: NDArray[np.float32]) -> bytes:
    return values.astype("<f4", copy=False).tobytes()


def _view(payload: bytes, offset: int, count: int) -> NDArray[np.float32]:
    values = np.frombuffer(payload, _WIRE_FLOAT, count, offset)
    if not (_WIRE_FLOAT.isnative and values.flags.aligned):
        # A longer header may leave the body unaligned; compiled loops want native, aligned numbers.
        values = values.astype(np.float32)
    values.flags.writeable = False
    return values
