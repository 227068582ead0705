"""Is a straight way free? The most doubtful place along it decides."""

import sys

import numpy as np

from clients.examples import run
from clients.map_client import MapClient

START, GOAL = (0.0, 0.0), (1.0, 1.0)
STEP_M = 0.05
RISK_MAX = 0.3


def main(url: str) -> None:
    """Print whether to drive, and where not."""
    steps = int(np.hypot(*np.subtract(GOAL, START)) / STEP_M) + 2
    way = np.linspace(START, GOAL, steps)
    with MapClient(url) as site:
        answer = site.query(way)
    risk = np.where(answer.known, answer.occupancy, 1.0)  # unknown is no road
    worst = int(risk.argmax())
    verdict = "drive" if risk[worst] <= RISK_MAX else "do not drive"
    x, y = way[worst]
    sys.stdout.write(f"{verdict}: risk {risk[worst]:.2f} at ({x:.2f}, {y:.2f})\n")


if __name__ == "__main__":
    run(main, "http://127.0.0.1:8080")
