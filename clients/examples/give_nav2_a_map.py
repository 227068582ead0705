"""Write map.pgm, map.yaml, variance.pgm and variance.yaml for Nav2's map_server."""

import io
import sys
import zipfile
from pathlib import Path

from clients.examples import run
from clients.map_client import MapClient

RESOLUTION_M = 0.1


def main(url: str, folder: str = "nav2-map") -> None:
    """Unpack the whole map into a folder."""
    with MapClient(url) as site:
        bounds = site.status().bounds
        if bounds is None:
            sys.exit("the map is empty")
        archive = site.raster(bounds, RESOLUTION_M, file_format="nav2")
    Path(folder).mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(archive)) as files:
        files.extractall(folder)
    sys.stdout.write(f"ros2 run nav2_map_server map_server with {folder}/map.yaml\n")


if __name__ == "__main__":
    run(main, "http://127.0.0.1:8080")
