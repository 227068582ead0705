"""Feeds the scan decoder what a coverage-guided fuzzer thinks of: `make fuzz`.

Without arguments it makes a million inputs. Every input must decode, and then survive encoding, or
be refused with InvalidScanError; all else is a crash. The checksum is set right in half of the
inputs, or the fuzzer would never get past it.
"""

import struct
import sys
import zlib

import atheris

with atheris.instrument_imports(include=["gpom_core.wire", "gpom_core.scan"]):
    from gpom_core import wire
    from gpom_core.errors import InvalidScanError


def check(data: bytes) -> None:
    if len(data) > 121 and data[-1] & 1:
        (length,) = struct.unpack_from("<H", data, 6)
        crc = zlib.crc32(data[length:], zlib.crc32(data[:116]))
        data = data[:116] + struct.pack("<I", crc) + data[120:]
    try:
        scan = wire.decode(data, max_beams=4096)
    except InvalidScanError as error:
        if not error.reason:
            raise RuntimeError("a refusal without a reason") from error
        return
    again = wire.decode(wire.encode(scan), max_beams=4096)
    if again.ranges_m.tobytes() != scan.ranges_m.tobytes():
        raise RuntimeError("encoding a decoded scan changed it")


if __name__ == "__main__":
    arguments = sys.argv if len(sys.argv) > 1 else [sys.argv[0], "-runs=1000000"]
    atheris.Setup([*arguments, "-max_len=2048", "-print_final_stats=1"], check)
    atheris.Fuzz()
