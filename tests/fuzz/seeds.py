"""Writes scans as a corpus for the fuzzer into a folder."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from gpom_core import wire
from tests.service.rooms import scan_at


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    scan = scan_at()
    few = np.array([1.0, np.inf, np.nan, -np.inf, 1e-45], np.float32)
    variants = [
        scan,
        replace(scan, ranges_m=few),
        replace(scan, ranges_m=few, intensities=np.zeros(5, np.float32), reliable=True, seq=2**47),
        replace(scan, ranges_m=few[:1], angle_increment_rad=-0.1),
    ]
    for number, variant in enumerate(variants):
        (folder / f"scan-{number}").write_bytes(wire.encode(variant))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
