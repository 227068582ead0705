"""How likely are these places occupied, and how sure is the map?"""

import sys

from clients.examples import run
from clients.map_client import MapClient

PLACES = [[0.0, 0.0], [1.5, 2.0], [100.0, 100.0]]


def main(url: str) -> None:
    """Print a line for each place."""
    with MapClient(url) as site:
        answer = site.query(PLACES)
    for (x, y), p, variance, known in zip(
        PLACES, answer.occupancy, answer.variance, answer.known, strict=True
    ):
        what = f"occupied {p:.1%}, variance {variance:.3f}" if known else "nobody has looked there"
        sys.stdout.write(f"({x:g}, {y:g}): {what}\n")


if __name__ == "__main__":
    run(main, "http://127.0.0.1:8080")
