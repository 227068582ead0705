"""Put every query of the dashboard to a running Prometheus: dashboard.py URL."""

import json
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

DASHBOARD = Path(__file__).parents[2] / "docker/grafana/gpom.json"
# Counters with labels appear with their first event, and here nothing is refused.
MAY_BE_EMPTY = {"sum by (reason) (rate(gpom_scans_refused_total[1m]))"}
PATIENCE_S = 90.0


def get(url: str, path: str, **parameters: str) -> dict:
    """Ask Prometheus' API."""
    query = urllib.parse.urlencode(parameters)
    with urllib.request.urlopen(f"{url}/api/v1/{path}?{query}", timeout=10) as answer:  # noqa: S310 - ours
        return json.load(answer)["data"]


def missing(url: str, queries: set[str]) -> set[str]:
    """Give the queries that have no answer yet."""
    return {query for query in queries if not get(url, "query", query=query)["result"]}


def main(url: str) -> None:
    """Wait until all of them have answers, and end with 1 if they do not get them."""
    panels = json.loads(DASHBOARD.read_text(encoding="utf-8"))["panels"]
    left = {target["expr"] for panel in panels for target in panel["targets"]} - MAY_BE_EMPTY
    rules: list[dict] = []
    end_s = time.monotonic() + PATIENCE_S
    while left and time.monotonic() < end_s:
        time.sleep(2.0)
        try:
            left = missing(url, left)
            rules = get(url, "rules")["groups"]
        except (urllib.error.URLError, ConnectionError) as error:
            sys.stdout.write(f"    Prometheus: {error}\n")
    alerts = [rule for group in rules for rule in group["rules"]]
    bad = [rule["name"] for rule in alerts if rule["health"] != "ok"]
    if left or bad or not alerts:
        sys.exit(f"no answer to {left}; rules that fail: {bad} of {len(alerts)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
