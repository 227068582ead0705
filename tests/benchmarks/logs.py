"""Real laser logs, where the folder named by GPOM_DATA has them."""

import os
from pathlib import Path

import pytest

from clients.protocol import read_scans
from gpom_core.scan import Scan


def real_log(name: str) -> list[Scan]:
    """The scans of a log, as the protocol reads them; skips the test when it is not there."""
    path = Path(os.environ.get("GPOM_DATA", "")) / f"{name}.corrected.log.gz"
    if not path.exists():
        pytest.skip(f"needs {path.name} in the folder named by GPOM_DATA")
    return read_scans(path)
