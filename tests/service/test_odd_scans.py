"""What sensors and their drivers may send on a bad day, past every check of a publisher."""

import struct
import zlib
from math import inf, nan

import numpy as np

from tests.service.rooms import payload_at

# Offsets of fields in the header of a scan.
STAMP, X, Y, YAW, ANGLE_MIN, INCREMENT, RANGE_MIN, RANGE_MAX = 32, 40, 48, 56, 88, 92, 100, 104
SUBNORMAL, LARGEST = 1e-42, 3.4e38
SOON_NS, NEVER_NS = 4_000_000_000 * 10**9, 2**63 - 1


def odd(changes: dict[int, tuple[str, float]], ranges=None) -> bytes:
    """A scan with other fields, and a checksum that is right all the same."""
    payload = bytearray(payload_at(seq=1))
    if ranges is not None:
        payload[120:] = np.asarray(ranges, "<f4").tobytes()
        struct.pack_into("<I", payload, 12, len(ranges))
    for offset, (form, value) in changes.items():
        struct.pack_into(form, payload, offset, value)
    checksum = zlib.crc32(payload[120:], zlib.crc32(payload[:116]))
    struct.pack_into("<I", payload, 116, checksum)
    return bytes(payload)


def beams(fill: float, n: int = 180, **others: float):
    ranges = np.full(n, fill, np.float32)
    for place, value in others.items():
        ranges[int(place[1:])] = value
    return ranges


ODD = {
    "no beams": odd({}, []),
    "a million beams": odd({}, beams(2.0, 1_000_000)),
    "nothing valid": odd({}, beams(nan)),
    "nothing in range": odd({}, beams(inf)),
    "too close": odd({}, beams(-inf)),
    "one valid beam": odd({}, beams(nan, _7=2.0)),
    "one beam": odd({}, beams(2.0, 1)),
    "subnormal ranges": odd({}, beams(SUBNORMAL)),
    "huge ranges": odd({}, beams(LARGEST)),
    "negative ranges": odd({}, beams(-2.0)),
    "increment 0": odd({INCREMENT: ("<f", 0.0)}),
    "increment negative": odd({INCREMENT: ("<f", -0.03)}),
    "increment subnormal": odd({INCREMENT: ("<f", SUBNORMAL)}),
    "increment huge": odd({INCREMENT: ("<f", LARGEST)}),
    "increment NaN": odd({INCREMENT: ("<f", nan)}),
    "angle inf": odd({ANGLE_MIN: ("<f", inf)}),
    "limits swapped": odd({RANGE_MIN: ("<f", 20.0), RANGE_MAX: ("<f", 0.05)}),
    "limit subnormal": odd({RANGE_MAX: ("<f", SUBNORMAL), RANGE_MIN: ("<f", 0.0)}),
    "limit huge": odd({RANGE_MAX: ("<f", LARGEST)}, beams(inf)),
    "x NaN": odd({X: ("<d", nan)}),
    "y inf": odd({Y: ("<d", -inf)}),
    "x 1e308": odd({X: ("<d", 1e308)}),
    "x 1e9": odd({X: ("<d", 1e9)}),
    "x 1e7": odd({X: ("<d", 1e7)}),
    "x subnormal": odd({X: ("<d", 5e-324)}),
    "yaw 1e308": odd({YAW: ("<d", 1e308)}),
    "future": odd({STAMP: ("<q", SOON_NS)}),
    "far future": odd({STAMP: ("<q", NEVER_NS)}),
    "before the epoch": odd({STAMP: ("<q", -1)}),
}
IN_THE_MAP = {
    "nothing valid", "nothing in range", "too close", "one valid beam", "one beam",
    "subnormal ranges", "huge ranges", "negative ranges", "increment negative", "x 1e7",
    "x subnormal", "future", "far future", "before the epoch",
}  # fmt: skip


def test_odd_scans_are_integrated_or_refused_with_a_reason(service, source) -> None:
    integrated = set()
    for seq, (name, payload) in enumerate(ODD.items()):
        before = service.state.scans_integrated
        source.put(f"robot-{seq}", "front", payload)
        service.flush().result(60.0)
        if service.state.scans_integrated > before:
            integrated.add(name)
        assert service.troubles() == [], name
    refused = service.metrics.registry.get_sample_value
    reasons = {
        sample.labels["reason"]: sample.value
        for metric in service.metrics.scans_refused.collect()
        for sample in metric.samples
        if sample.name.endswith("_total")
    }
    assert "internal_error" not in reasons
    assert sum(reasons.values()) == len(ODD) - len(integrated)
    assert refused("gpom_loop_errors_total", {"thread": "mapping"}) is None
    assert refused("gpom_loop_errors_total", {"thread": "ingest"}) is None
    assert integrated >= IN_THE_MAP
    before = service.state.scans_integrated
    source.put("good", "front", payload_at(seq=1))
    service.flush().result(60.0)
    assert service.state.scans_integrated == before + 1
    answer = service.state.snapshot.query([[0.0, 0.0], [1e9, 0.0], [1e308, -1e308]])
    assert answer.occupancy[1:].tolist() == [0.5, 0.5]
    assert np.isfinite(service.state.snapshot.query([[2.9, 0.1]]).variance).all()
