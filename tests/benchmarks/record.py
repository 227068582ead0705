"""Figures of a benchmark: printed as JSON beside those that were committed last.

With BENCH_KEEP set they are written to `results/`, to be committed.
"""

import json
import os
from pathlib import Path

RESULTS = Path(__file__).parent / "results"

Figures = dict[str, float | str]


def record(name: str, command: str, figures: Figures) -> None:
    """Print figures, and how they compare with the last committed ones.

    Args:
        command: how to get them again.
    """
    kept = RESULTS / f"{name}.json"
    before = json.loads(kept.read_text())["figures"] if kept.exists() else {}
    times = {
        key: round(value / before[key], 2)
        for key, value in figures.items()
        if isinstance(value, float) and isinstance(before.get(key), float) and before[key]
    }
    shown = {"command": command, "figures": figures}
    print("\n" + json.dumps({**shown, "times_the_last_committed": times}, indent=1))
    if os.environ.get("BENCH_KEEP"):
        kept.write_text(json.dumps(shown, indent=1) + "\n")


def rounded(value: float, digits: int = 3) -> float:
    """A figure without the digits that mean nothing."""
    return float(f"{value:.{digits}g}")
