"""The evaluation protocol, and the command that runs it, on a simulated room."""

import json
import os
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from clients.contenders import Contender, grids
from clients.errors import LogReadError
from clients.evaluate import evaluate_command, prepare, report
from clients.protocol import (
    capped,
    evaluate,
    far_from_beams,
    held_out_points,
    hit_ends,
    labelled_points,
    parse_share,
    read_scans,
    split,
    thin,
)
from gpom_core.baselines import CountingGrid, LogOddsGrid
from gpom_core.errors import ConfigurationError, InvalidQueryError
from gpom_core.scan import Scan
from tests.clients.fake_http import STATUS, running_http_map
from tests.clients.rooms import BEAMS, room_log, room_scan


@pytest.fixture(scope="module")
def room() -> list[Scan]:
    return [room_scan(index) for index in range(40)]


@pytest.fixture
def log(tmp_path: Path, room: list[Scan]) -> Path:
    """Write the room as a CARMEN log."""
    return room_log(tmp_path / "room.log", room)


def invoke(*arguments: str) -> Result:
    app = typer.Typer()
    app.command()(evaluate_command)
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


def run(*arguments: str) -> dict:
    return json.loads(invoke(*arguments).stdout)


def test_scans_5_15_25_are_held_out(room: list[Scan]) -> None:
    training, held_out = split(room)
    assert held_out == [room[5], room[15], room[25], room[35]]
    assert len(training) == 36
    assert not set(map(id, training)) & set(map(id, held_out))


@given(st.integers(1, 40), st.integers(0, 200))
def test_a_share_of_one_over_k_is_every_kth_scan(k: int, n: int) -> None:
    scans = [room_scan(0)] * n
    assert len(thin(scans, Fraction(1, k))) == -(-n // k)
    assert len(thin(scans, parse_share(f"1/{k}"))) == len(thin(scans, 1 / k))


@pytest.mark.parametrize("text", ["2/3", "0", "-1/3", "many", "1/0", "2"])
def test_other_shares_are_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="1/30"):
        parse_share(text)


@pytest.mark.parametrize("share", [0.0, 1.5, float("nan")])
def test_shares_outside_the_unit_interval_are_refused(room: list[Scan], share: float) -> None:
    with pytest.raises(ConfigurationError, match="at most 1"):
        thin(room, share)


def test_no_returns_and_long_ranges_are_ignored() -> None:
    ranges_m = np.array([1.0, np.inf, 20.0, 20.01, np.nan, 0.001, 29.0])
    scan = replace(room_scan(0), ranges_m=ranges_m)
    assert capped(scan).hits().tolist() == [True, False, True, False, False, False, False]
    assert not capped(scan).no_returns().any()


def test_hits_lie_on_the_walls(room: list[Scan]) -> None:
    ends = hit_ends(room[7])
    assert np.allclose(np.max(np.abs(ends) - [4.0, 3.0], axis=1), 0.0, atol=1e-5)


def test_test_points_are_hits_and_free_points_short_of_them(room: list[Scan]) -> None:
    scan = room[5]
    drawn = labelled_points([scan], seed=3, keep=None)
    place = np.array(scan.pose[:2])
    assert np.array_equal(drawn.points[drawn.occupied], hit_ends(scan))
    free = np.linalg.norm(drawn.points[~drawn.occupied] - place, axis=1)
    reach = scan.ranges_m.astype(np.float64) - 0.2
    assert len(free) == BEAMS
    assert np.all((free >= 0.0) & (free < reach))
    assert np.mean(free / reach) == pytest.approx(0.5, abs=0.1)


def test_beams_of_30_cm_and_less_give_no_free_point() -> None:
    scan = replace(room_scan(0), ranges_m=np.array([0.25, 0.31, 5.0, np.nan, np.inf]))
    drawn = labelled_points([scan], seed=0)
    assert drawn.occupied.sum() == 3
    assert (~drawn.occupied).sum() == 2


def test_the_draw_depends_on_the_seed_alone(room: list[Scan]) -> None:
    first, again, other = (held_out_points(room, seed, keep=100) for seed in (0, 0, 1))
    assert len(first) == 100
    assert np.array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)


def test_far_points_are_far_from_every_beam(room: list[Scan]) -> None:
    training = room[:2]
    rng = np.random.default_rng(0)
    points = rng.uniform(-6.0, 6.0, (500, 2))
    nearest = np.full(len(points), np.inf)
    for scan in training:
        start, ends = np.array(scan.pose[:2]), hit_ends(scan)
        for end in ends:
            along = end - start
            t = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
            away = np.linalg.norm(points - start - t[:, None] * along, axis=1)
            nearest = np.minimum(nearest, away)
    far = far_from_beams(points, training, 0.5)
    assert far.any()
    assert np.all(nearest[far] > 0.5)
    assert np.all(nearest[~far] < 0.5 + 2 * 0.05 * np.sqrt(0.5) + 1e-6)
    assert far_from_beams(points, [], 0.5).all()
    with pytest.raises(ConfigurationError, match="more than 0"):
        far_from_beams(points, training, 0.0)


def test_evaluate_scores_a_map_and_counts_the_unknown() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    occupied = points[:, 0] > 1.5
    scores = evaluate(lambda p: (p[:, 0] / 3.0, p[:, 0] != 1.0), points, occupied)
    assert scores.auc == 1.0
    assert scores.share_unknown == 0.25


def test_the_tuned_grid_is_no_worse_than_the_worst_and_knows_the_room(room: list[Scan]) -> None:
    trial = prepare("room", room, Fraction(1), seed=0)
    methods = report(trial, grids(trial.training))["methods"]
    assert len(methods) == 7
    tuned = methods["counting grid tuned"]
    assert tuned["auc"] > 0.98
    assert tuned["nll"] <= max(m["nll"] for n, m in methods.items() if n.startswith("counting"))


def test_one_training_scan_is_enough_for_the_grids(room: list[Scan]) -> None:
    trial = prepare("room", room, Fraction(1, 40), seed=0)
    assert len(trial.training) == 1
    methods = report(trial, grids(trial.training))["methods"]
    assert methods["counting grid tuned"]["resolution_m"] == 0.1


def test_a_log_without_held_out_scans_is_refused(room: list[Scan]) -> None:
    with pytest.raises(ConfigurationError, match="six scans"):
        prepare("room", room[:5], Fraction(1), seed=0)


@pytest.mark.parametrize(
    ("range_m", "expected"),
    [(21.0, "no hit: .* longer than 20 m"), (0.2, "no passing beam: all hits are nearer")],
)
def test_a_log_that_cannot_test_a_map_is_told_why(
    room: list[Scan], range_m: float, expected: str
) -> None:
    scans = [capped(replace(scan, ranges_m=np.full(BEAMS, range_m))) for scan in room]
    with pytest.raises(ConfigurationError, match=rf"room cannot test a map: .* {expected}"):
        prepare("room", scans, Fraction(1), seed=0)


def test_far_scores_are_left_out_when_only_one_label_is_there(room: list[Scan]) -> None:
    trial = prepare("room", room, Fraction(1), seed=0, far_m=0.5)
    grid = CountingGrid(0.1)
    result = report(trial, [Contender("empty", grid.occupancy)])
    assert result["far_points"] == len(trial.far)
    assert result["methods"]["empty"]["far"] is None
    assert result["methods"]["empty"]["share_unknown"] == 1.0


def test_the_command_builds_scores_and_prints_json(log: Path) -> None:
    result = run(str(log), "--share", "1/3", "--fusion", "bcm", "--fusion", "poe", "--baselines")
    assert result["share"] == "1/3"
    assert result["training_scans"] == 12
    assert result["held_out_scans"] == 4
    assert result["points"] == 1440
    assert len(result["methods"]) == 9
    ours = result["methods"]["gpom bcm"]
    assert ours["auc"] > 0.95
    assert ours["experts"] > 0
    assert ours["observations"] > 100
    assert {"build_s", "training_s", "query_s", "nll", "brier", "ece", "share_unknown"} <= set(ours)
    assert result["methods"]["gpom poe"]["share_unknown"] == 0.0


def test_the_command_scores_a_running_service_and_builds_nothing(log: Path) -> None:
    with running_http_map() as service:  # says 0.5 everywhere, and knows where x > 0
        result = run(str(log), "--url", service.url, "--fusion", "rbcm")
    (ours,) = result["methods"].values()
    points = held_out_points(read_scans(log), seed=0).points
    assert ours["nll"] == pytest.approx(np.log(2.0))
    assert ours["share_unknown"] == np.mean(points[:, 0] <= 0.0)
    assert ours["experts"] == STATUS["experts"]
    assert "build_s" not in ours


@pytest.mark.parametrize(("share", "scans", "other"), [("1/4", 9, True), ("1/3", 12, False)])
def test_the_command_warns_when_the_service_holds_other_scans(
    log: Path, share: str, scans: int, other: bool
) -> None:
    with running_http_map() as service:
        status = json.dumps(STATUS | {"scans_integrated": 12}).encode()
        service.answers["/v1/status"] = 200, "application/json", status
        result = invoke(str(log), "--url", service.url, "--share", share)
    told = json.loads(result.stdout)
    assert told["training_scans"] == scans
    assert [of["scans_integrated"] for of in told["methods"].values()] == [12]
    expected = f"holds 12 scans and share {share} of the training scans is {scans}: its figures"
    assert (expected in result.stderr) == other
    assert bool(result.stderr) == other


def test_an_unknown_fusion_rule_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InvalidQueryError, match="average"):
        run(str(tmp_path / "never_read.log"), "--fusion", "average")


def test_a_missing_log_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(LogReadError):
        run(str(tmp_path / "none.log"))


@pytest.fixture(scope="module")
def intel() -> list[Scan]:
    folder = os.environ.get("GPOM_DATA")
    if not folder or not (path := Path(folder) / "intel.corrected.log.gz").exists():
        pytest.skip("needs intel.corrected.log.gz in the folder named by GPOM_DATA")
    return read_scans(path)


@pytest.mark.data
def test_the_draw_on_intel_never_changes(intel: list[Scan]) -> None:
    test = held_out_points(intel, seed=0)
    assert len(test) == 10_000
    assert test.occupied.sum() == 4996
    assert test.points[:2].ravel() == pytest.approx(
        [0.48240829, 1.09160258, 0.46419816, 1.08833905], abs=1e-6
    )


@pytest.mark.data
@pytest.mark.parametrize(
    ("kind", "resolution_m", "share", "auc", "nll"),
    [
        (CountingGrid, 0.1, Fraction(1), 0.997, 0.070),
        (CountingGrid, 0.1, Fraction(1, 3), 0.996, 0.082),
        (CountingGrid, 0.1, Fraction(1, 10), 0.987, 0.158),
        (LogOddsGrid, 0.2, Fraction(1), 0.974, 0.185),
    ],
)
def test_grids_on_all_held_out_points_of_intel(
    intel: list[Scan], kind: type, resolution_m: float, share: Fraction, auc: float, nll: float
) -> None:
    grid = kind(resolution_m)
    for scan in thin(split(intel)[0], share):
        grid.add(np.array(scan.pose[:2]), hit_ends(scan))
    test = held_out_points(intel, seed=0, keep=None)
    scores = evaluate(grid.occupancy, test.points, test.occupied)
    assert scores.auc == pytest.approx(auc, abs=1e-3)
    assert scores.nll == pytest.approx(nll, abs=1e-3)
