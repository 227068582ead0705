"""Ten robots as rmw_zenoh has them, in a process of their own: python -m … ENDPOINT ROBOTS HZ S."""

import sys
import time

import numpy as np

from gpom_core.ros.attachment import Attachment, write
from tests.gpom_core.ros.samples import STORE, cdr, laser_scan, tf
from tests.service.fleet_link import open_session
from tests.service.rooms import scan_at

SCAN, TF = "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage"
BEAMS = 360


def key(topic: str, kind: str) -> str:
    package, _, name = kind.split("/")
    return f"0/{topic}/{package}::msg::dds_::{name}_/{STORE.hash_rihs01(kind)}"


def main(endpoint: str, robots: int, rate_hz: float, seconds: float) -> None:
    ranges = np.interp(np.linspace(0, 179, BEAMS), np.arange(180), scan_at(0.0, 0.0).ranges_m)
    with open_session(connect=endpoint) as session:
        publishers = []
        for index in range(robots):
            session.put(key(f"r{index}/tf_static", TF), cdr(tf(("base", "laser", (0.1, 0, 0), 0))))
            topics = ((f"r{index}/tf", TF), (f"r{index}/scan", SCAN))
            publishers.append([session.declare_publisher(key(*topic)) for topic in topics])
        total = int(rate_hz * seconds) * robots
        start_s = time.monotonic()
        for number in range(total):
            wait_s = start_s + number / (rate_hz * robots) - time.monotonic()
            if wait_s > 0:
                time.sleep(wait_s)
            turn, index = divmod(number, robots)
            transforms, scans = publishers[index]
            now_ns = time.time_ns()
            pose = (index / 10 + turn % 40 / 100, 0.0, 0.0)
            # Just after a scan its transform comes, as localisation gives it.
            message = laser_scan(now_ns, "laser", ranges, angle_increment=2 * np.pi / BEAMS)
            beside = write(Attachment(turn + 1, now_ns, bytes([index]) * 16))
            scans.put(cdr(message), attachment=beside)
            transforms.put(cdr(tf(("map", "base", pose, now_ns))))
        time.sleep(0.5)


if __name__ == "__main__":
    main(sys.argv[1], int(float(sys.argv[2])), float(sys.argv[3]), float(sys.argv[4]))
