"""Laws of the wire format: scans round-trip, and no bytes whatever do harm."""

import struct
import zlib
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gpom_core.errors import InvalidScanError
from gpom_core.scan import Pose2D, Scan
from gpom_core.wire import decode, encode, renumber

small = st.floats(-100.0, 100.0, width=32)
coordinates = st.floats(-1e7, 1e7)
range_values = st.floats(width=32)
boots, seqs = st.integers(0, 2**63 - 2), st.integers(0, 2**48 - 1)


@st.composite
def scans(draw: st.DrawFn) -> Scan:
    ranges_m = draw(arrays.arrays(np.float32, st.integers(1, 50), elements=range_values))
    seq = draw(seqs)
    intensities = st.none() | arrays.arrays(np.float32, ranges_m.shape, elements=range_values)
    return Scan(
        pose=Pose2D(draw(coordinates), draw(coordinates), draw(small)),
        ranges_m=ranges_m,
        angle_min_rad=draw(small),
        angle_increment_rad=draw(st.floats(-1.0, 1.0, width=32).filter(bool)),
        range_min_m=draw(st.floats(0.0, 1.0, width=32)),
        range_max_m=draw(st.floats(2.0, 1000.0, width=32)),
        stamp_ns=draw(st.integers(-(2**63), 2**63 - 1)),
        boot=draw(boots),
        seq=seq,
        reliable=draw(st.booleans()) and seq > 0,
        time_increment_s=draw(small),
        scan_time_s=draw(small),
        pose_covariance=draw(st.tuples(*[small] * 6)),
        intensities=draw(intensities),
    )


def values(scan: Scan) -> list[object]:
    """Give all of a scan in a form that can be compared, NaNs bit by bit."""
    names = [name for name in Scan.__slots__ if name not in ("ranges_m", "intensities")]
    intensities = None if scan.intensities is None else scan.intensities.tobytes()
    return [getattr(scan, name) for name in names] + [scan.ranges_m.tobytes(), intensities]


def decode_or_refuse(payload: bytes) -> None:
    with suppress(InvalidScanError):
        scan = decode(payload)
        assert encode(scan)
        assert scan.hits().shape == scan.no_returns().shape == scan.ranges_m.shape
        assert not np.any(scan.hits() & scan.no_returns())
        assert np.isfinite(scan.beam_angles_rad()).all()


@given(scans())
def test_a_scan_comes_back_as_it_went(scan: Scan) -> None:
    assert values(decode(encode(scan))) == values(scan)


@given(scans())
def test_bytes_come_back_as_they_went(scan: Scan) -> None:
    payload = encode(scan)

    assert encode(decode(payload)) == payload


@given(st.binary(max_size=400))
def test_noise_is_refused(payload: bytes) -> None:
    decode_or_refuse(payload)


@given(scans(), st.data())
def test_a_cut_scan_is_refused(scan: Scan, data: st.DataObject) -> None:
    payload = encode(scan)
    length = data.draw(st.integers(0, len(payload) - 1))

    with pytest.raises(InvalidScanError) as caught:
        decode(payload[:length])

    assert caught.value.reason == "truncated"


@given(scans(), st.data(), st.booleans())
def test_overwritten_bytes_do_no_harm(scan: Scan, data: st.DataObject, seal: bool) -> None:
    """Even with a CRC that matches, as from a broken or hostile sender."""
    payload = bytearray(encode(scan))
    noise = data.draw(st.binary(min_size=1, max_size=16))
    offset = data.draw(st.integers(0, len(payload) - len(noise)))
    payload[offset : offset + len(noise)] = noise
    if seal:
        crc = zlib.crc32(payload[120:], zlib.crc32(payload[:116]))
        struct.pack_into("<I", payload, 116, crc)

    decode_or_refuse(bytes(payload))


@given(scans(), boots, st.integers(1, 2**48 - 1))
def test_renumbering_changes_the_number_alone(scan, boot, seq):
    renumbered = renumber(encode(scan), boot, seq)
    assert renumbered == encode(replace(scan, boot=boot, seq=seq))
