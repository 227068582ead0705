"""Squares that changed are those, and only those, in which two versions answer differently."""

import numpy as np
import pytest

from gpom_core import Mapper
from gpom_core.changes import SQUARE_M, changed_squares, squares
from gpom_core.link import Link
from gpom_core.snapshot import Snapshot
from tests.service.rooms import scan_at

FAR_M = 5 * SQUARE_M


@pytest.fixture(scope="module")
def versions() -> tuple[Snapshot, Snapshot]:
    """A map of one room, and later of two."""
    mapper = Mapper()
    mapper.update(scan_at())
    before = mapper.train()
    scan = scan_at()
    mapper.update(type(scan)(**_fields(scan) | {"pose": scan.pose._replace(x_m=FAR_M)}))
    return before, mapper.train()


def _fields(scan) -> dict[str, object]:
    return {name: getattr(scan, name) for name in scan.__dataclass_fields__}


def test_nothing_changes_between_a_version_and_itself(versions) -> None:
    assert changed_squares(versions[1], versions[1]) == set()


def test_the_first_version_changes_all_that_it_knows(versions) -> None:
    assert changed_squares(Snapshot(), versions[0]) == squares(versions[0]) != set()


def test_squares_that_did_not_change_answer_the_same(versions) -> None:
    before, now = versions
    now = Snapshot(**{f: getattr(now, f) for f in now.__dataclass_fields__} | {
        "link": before.link})  # fmt: skip
    changed = changed_squares(before, now)
    points = np.random.default_rng(0).uniform(-10.0, FAR_M + 10.0, (3000, 2))
    inside = [(int(x), int(y)) in changed for x, y in np.floor(points / SQUARE_M)]

    same = before.query(points).mean == now.query(points).mean

    assert (5, 0) in changed
    assert (0, 0) not in changed
    assert same[~np.array(inside)].all()


def test_another_calibration_changes_all(versions) -> None:
    recalibrated = versions[1].with_link(Link((3.0, 0.0, 0.0, 0.0, 0.0, 0.0)))

    assert changed_squares(versions[1], recalibrated) == squares(versions[1])
