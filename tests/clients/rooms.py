"""A simulated room and its log, for the commands that measure accuracy."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gpom_core.scan import Pose2D, Scan

BEAMS = 180
WALLS_M = np.array([[-4.0, 4.0], [-3.0, 3.0]])


def room_scan(index: int) -> Scan:
    """One sweep inside a room of 8 x 6 m, from a place that depends on the index."""
    pose = Pose2D(2.5 * np.sin(0.4 * index), 1.5 * np.cos(0.3 * index), 0.7 * index)
    angle = pose.yaw_rad - np.pi / 2 + np.pi / BEAMS * np.arange(BEAMS)
    step = np.array([np.cos(angle), np.sin(angle)])
    place = np.array(pose[:2])[:, None]
    with np.errstate(divide="ignore"):
        ranges_m = np.max((WALLS_M[:, None, :] - place[..., None]) / step[..., None], axis=2)
    return Scan(
        pose=pose,
        ranges_m=ranges_m.min(axis=0),
        angle_min_rad=-np.pi / 2,
        angle_increment_rad=np.pi / BEAMS,
        range_min_m=0.01,
        range_max_m=30.0,
    )


def room_log(path: Path, scans: Sequence[Scan]) -> Path:
    """Write scans as a CARMEN log."""
    lines = []
    for index, scan in enumerate(scans):
        ranges = " ".join(f"{r:.3f}" for r in scan.ranges_m)
        pose = " ".join(f"{v:.6f}" for v in scan.pose)
        lines.append(f"FLASER {BEAMS} {ranges} {pose} {pose} {index} here {index}")
    path.write_text("\n".join(lines) + "\n")
    return path
