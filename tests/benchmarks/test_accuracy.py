"""Accuracy of the map and of the grids on every log in GPOM_DATA, at four shares of the scans.

One table and one JSON document; the document also goes to the file named by GPOM_BENCH_OUT.
"""

import json
import os
from pathlib import Path

import pytest

from clients.contenders import gpom_map, grids
from clients.evaluate import prepare, report
from clients.protocol import SHARES, read_scans

SHOWN = ("auc", "nll", "brier", "ece", "share_unknown")


def logs() -> list[Path]:
    folder = os.environ.get("GPOM_DATA")
    return sorted(Path(folder).glob("*.log.gz")) if folder else []


def row(log: str, share: str, name: str, method: dict) -> str:
    cost_s = method.get("build_s", 0.0) + method.get("training_s", 0.0)
    values = "  ".join(f"{method[key]:8.4f}" for key in SHOWN)
    return f"{log:8}{share:>6}  {name:22}{values}  {cost_s:8.2f}"


@pytest.mark.benchmark
@pytest.mark.timeout(1800)
def test_accuracy_on_all_logs() -> None:
    paths = logs()
    if not paths:
        pytest.skip("needs CARMEN logs (*.log.gz) in the folder named by GPOM_DATA")
    heads = "  ".join(f"{key[:8]:>8}" for key in SHOWN)
    print(f"\n{'log':8}{'share':>6}  {'method':22}{heads}  {'cost s':>8}")
    reports = []
    for path in paths:
        scans = read_scans(path)
        for share in SHARES:
            trial = prepare(path.name, scans, share, seed=0, far_m=0.5)
            result = report(trial, [*gpom_map(trial.training), *grids(trial.training)])
            reports.append(result)
            for name, method in result["methods"].items():
                print(row(path.name.partition(".")[0], str(share), name, method))
    document = json.dumps(reports, indent=1)
    out = os.environ.get("GPOM_BENCH_OUT")
    if out:
        Path(out).write_text(document + "\n")
    else:
        print(document)
