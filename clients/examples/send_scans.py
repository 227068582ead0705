"""Your own robot: publish scans with poses, and wait until the map has stored them."""

import sys
from math import pi

import numpy as np

from clients.examples import run
from clients.publisher import ScanPublisher
from gpom_core import Pose2D, Scan

BEAMS = 360


def main(endpoint: str, robot: str = "my-robot") -> None:
    """Send three scans of a round room, 2 m wide on each side."""
    with ScanPublisher(robot, endpoints=[endpoint]) as publisher:
        publisher.wait_ready()
        for step in range(3):
            pose = Pose2D(0.05 * step, 0.0, 0.0)  # of the sensor, in the frame of the map
            ranges_m = np.full(BEAMS, 2.0, np.float32)  # what your driver gives
            publisher.publish(Scan(pose, ranges_m, -pi, 2 * pi / BEAMS, 0.1, 30.0))
        stored = publisher.drain(timeout_s=30.0)
    sys.stdout.write("stored\n" if stored else "not all of them are stored\n")


if __name__ == "__main__":
    run(main, "tcp/127.0.0.1:7447")
