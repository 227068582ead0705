"""The tracked lines of the map, in a file that any map program opens."""

import sys
from pathlib import Path

import httpx

from clients.examples import run


def main(url: str, file: str = "clusters.geojson") -> None:
    """Write the file; coordinates are metres."""
    answer = httpx.get(f"{url.rstrip('/')}/v1/experts", params={"format": "geojson"})
    Path(file).write_bytes(answer.raise_for_status().content)
    sys.stdout.write(f"{len(answer.json()['features'])} lines in {file}\n")


if __name__ == "__main__":
    run(main, "http://127.0.0.1:8080")
