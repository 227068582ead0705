"""Compiles, or loads from the cache, every kernel that scans, training and queries will run."""

import logging
import time
from math import pi

import numpy as np

from gpom_core.config import MapConfig
from gpom_core.mapper import Mapper
from gpom_core.scan import Pose2D, Scan

logger = logging.getLogger(__name__)


def warm_up(config: MapConfig) -> None:
    """Drive a small map of its own through all that a real one does."""
    start_s = time.perf_counter()
    mapper = Mapper(config)
    beams = 180
    ranges_m = np.full(beams, 2.0, np.float32)
    ranges_m[:20] = np.inf
    mapper.update(
        Scan(
            pose=Pose2D(0.0, 0.0, 0.0),
            ranges_m=ranges_m,
            angle_min_rad=-pi,
            angle_increment_rad=2.0 * pi / beams,
            range_min_m=0.1,
            range_max_m=10.0,
        )
    )
    snapshot = mapper.train()
    for fusion in ("bcm", "rbcm", "poe"):
        snapshot.query(np.zeros((2, 2)), fusion)
    snapshot.grid((-1.0, -1.0, 1.0, 1.0), 0.5)
    snapshot.grid((-0.2, -0.2, 0.2, 0.2), 0.01, method="field")  # enough cells to fill tiles
    snapshot.experts()
    logger.info("kernels are ready after %.1f s", time.perf_counter() - start_s)
