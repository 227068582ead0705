"""Half an hour of steady load on the real service, watched from outside: `make soak`.

Robots drive around and queries are asked. Afterwards everything sent must be stored and in the
map, and memory, file descriptors and threads of the service must be what they were after the
first fifth, when the map of the place was complete.
"""

import random
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from tests.faults.parts import Robot, Service, assert_nothing_lost

ROBOTS = 4
RATE_HZ = 10.0
SAMPLE_S = 5.0
MEMORY_SHARE_MAX = 1.15
COUNT_MORE_MAX = 4


class Sample(NamedTuple):
    """What the operating system says of the service."""

    memory_mb: float
    files: int
    threads: int


def sample(pid: int) -> Sample:
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    return Sample(
        int(status["VmRSS"].split()[0]) / 1024.0,
        sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir()),
        int(status["Threads"]),
    )


def main(duration_s: float) -> int:
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Path(folder))
        service.start()
        service.wait_ready()
        robots = [Robot(f"robot-{i}", service.endpoint, RATE_HZ) for i in range(ROBOTS)]
        for robot in robots:
            robot.start()
        samples, slowest_s, chance = [], 0.0, random.Random(1)
        end = time.monotonic() + duration_s
        while time.monotonic() < end:
            start = time.monotonic()
            x, y = chance.uniform(-3, 3), chance.uniform(-3, 3)
            assert service.get(f"/v1/query?x={x}&y={y}").is_success
            slowest_s = max(slowest_s, time.monotonic() - start)
            samples.append(sample(service.process.pid))
            time.sleep(SAMPLE_S)
        for robot in robots:
            robot.finish()
        scans = assert_nothing_lost(service, robots)
        service.kill()
    early, late = samples[len(samples) // 5], samples[-1]
    print(
        f"soak seconds={duration_s:g} scans={scans} lost=0 slowest_query_s={slowest_s:.2f} "
        f"early={early} late={late}"
    )
    flat = late.memory_mb <= MEMORY_SHARE_MAX * early.memory_mb and all(
        late[i] <= early[i] + COUNT_MORE_MAX for i in (1, 2)
    )
    print("flat" if flat else "NOT FLAT")
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]) if len(sys.argv) > 1 else 1800.0))
