"""Hear of every new version of the map and where it changed, as it happens."""

import json
import sys

import httpx

from clients.examples import run


def main(url: str, count: str = "3") -> None:
    """Print so many pieces of news."""
    left = int(count)
    with httpx.stream("GET", f"{url.rstrip('/')}/v1/events", timeout=30.0) as events:
        kind = ""
        for line in events.iter_lines():
            name, _, value = line.partition(": ")
            if name == "event":
                kind = value
            elif name == "data" and left:
                sys.stdout.write(f"{kind}: {json.dumps(json.loads(value))}\n")
                left -= 1
            if not left:
                return


if __name__ == "__main__":
    run(main, "http://127.0.0.1:8080")
