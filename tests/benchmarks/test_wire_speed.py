"""How long a scan takes into bytes and back."""

import timeit

import numpy as np
import pytest

from gpom_core.scan import Pose2D, Scan
from gpom_core.wire import decode, encode

ROUNDS = 1000


def microseconds(work: str, **names: object) -> float:
    return min(timeit.repeat(work, globals=names, number=ROUNDS, repeat=5)) / ROUNDS * 1e6


@pytest.mark.benchmark
@pytest.mark.parametrize("beams", [1, 360, 1440, 20_000])
def test_scan_to_bytes_and_back(beams: int) -> None:
    ranges_m = np.linspace(1.0, 20.0, beams, dtype=np.float32)
    scan = Scan(Pose2D(1.0, 2.0, 3.0), ranges_m, -np.pi, 2 * np.pi / beams, 0.1, 30.0, seq=1)
    payload = encode(scan)

    encode_us = microseconds("encode(scan)", encode=encode, scan=scan)
    decode_us = microseconds("decode(payload)", decode=decode, payload=payload)

    print(
        f"\n{beams} beams, {len(payload)} B: encode {encode_us:.1f} us, decode {decode_us:.1f} us"
    )
    assert encode_us < 1000
    assert decode_us < 1000
