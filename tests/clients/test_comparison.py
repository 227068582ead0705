"""The comparison: everyone is asked the same, promises are judged as stated, files are written."""

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from clients.comparison import peers, study
from clients.comparison.command import compare, labels
from clients.comparison.places import AT, BEFORE, BEHIND, FAR, OPEN, places
from clients.comparison.report import as_markdown
from clients.comparison.study import SCORES, Result, Round, Spread, play
from clients.comparison.targets import ALL, GRID, MAP, TENTH, THIRD, TUNED_GRID, verdicts
from clients.errors import LogReadError
from clients.protocol import labelled_points, split
from gpom_core.errors import ConfigurationError
from gpom_core.metrics import reliability_curve
from gpom_core.scan import Pose2D, Scan
from tests.clients.rooms import room_log, room_scan

SCANS = [room_scan(index) for index in range(24)]
CURVE = reliability_curve(np.array([0.1, 0.9]), np.array([False, True]))


def result(method: str, **scores: float) -> Result:
    spread = {name: Spread(scores.get(name, 0.0), 0.0) for name in SCORES}
    return Result(method, spread, {}, CURVE, {})


def one_round(share: Fraction, nll: float, grid_nll: float, ece: float = 0.01) -> Round:
    results = (
        result(MAP, nll=nll, auc=0.99, ece=ece),
        result(GRID, nll=grid_nll, auc=0.98),
        result(TUNED_GRID, nll=grid_nll, auc=0.98),
    )
    return Round("site", share, 100, 1, results)


def test_all_methods_answer_the_same_points() -> None:
    one = play("room", SCANS, Fraction(1, 3), draws=2, with_peers=False)
    names = [r.method for r in one.results]
    assert names == [MAP, "gpom uncalibrated", GRID, TUNED_GRID, "log-odds grid"]
    assert one.training_scans == 8
    sizes = {int(r.reliability.count.sum()) for r in one.results}
    assert sizes == {sum(len(labelled_points(split(SCANS)[1], seed)) for seed in range(2))}
    assert all(r.scores["auc"].mean > 0.9 for r in one.results)


def test_a_log_without_held_out_scans_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="six scans"):
        play("short", SCANS[:4], Fraction(1), draws=1, with_peers=False)


def test_a_log_without_hits_is_refused_for_that() -> None:
    blind = [replace(scan, ranges_m=np.full(len(scan.ranges_m), np.nan)) for scan in SCANS]
    with pytest.raises(ConfigurationError, match=r"blind .* held-out scans .* have no hit"):
        play("blind", blind, Fraction(1), draws=1, with_peers=False)


def test_logs_have_labels_of_their_own() -> None:
    paths = [Path(p) for p in ("intel.log", "a/aces.log.gz", "aces.bag", "b/aces.bag", ".log")]
    assert labels(paths) == dict(
        zip(["intel", "aces.log.gz", "aces.bag", "b/aces.bag", ".log"], paths, strict=True)
    )
    with pytest.raises(ConfigurationError, match=r"a.log and b/../a.log are the same log"):
        labels([Path("a.log"), Path("b.log"), Path("b/../a.log")])


def test_what_is_asked_wrongly_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clients.comparison.command.play", None)  # a first round would be an error
    log = room_log(tmp_path / "room.log", SCANS)
    short = room_log(tmp_path / "short.log", SCANS[:4])
    with pytest.raises(LogReadError, match="cannot read"):
        compare([log, tmp_path / "none.log"])
    with pytest.raises(ConfigurationError, match="short has 4 scans; expected six scans or more"):
        compare([log, short], output=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ConfigurationError, match=r"short\.log is a file"):
        compare([log], output=short)


def test_a_run_that_is_stopped_prints_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ends = iter([one_round(ALL, 0.08, 0.1)])
    monkeypatch.setattr("clients.comparison.command.play", lambda *_, **__: next(ends))
    with pytest.raises(StopIteration):
        compare([room_log(tmp_path / "room.log", SCANS)], shares="1,1/3")
    assert f"| site | 1 | {MAP} | 0.9900 | 0.0800 |" in capsys.readouterr().out


def test_one_draw_has_no_spread() -> None:
    one = one_round(ALL, 0.08, 0.1)
    assert "±" not in as_markdown([one], {})
    assert "0.0800 ± 0.0000" in as_markdown([replace(one, draws=2)], {})


def test_every_point_is_in_one_place() -> None:
    """A wall 4 m ahead, seen from the origin by 21 beams within half a metre of the axis."""
    angle = np.linspace(-0.125, 0.125, 21)
    wall = Scan(Pose2D(0.0, 0.0, 0.0), 4.0 / np.cos(angle), angle[0], angle[1] - angle[0], 0.1, 9.0)
    at = {
        AT: [3.95, 0.0], BEFORE: [3.7, 0.1], BEHIND: [4.3, 0.1], OPEN: [2.0, 0.0], FAR: [4.7, 0.0],
    }  # fmt: skip
    found = places(np.array(list(at.values())), [wall])
    assert {place: mask.tolist() for place, mask in found.items()} == {
        place: [place == other for other in at] for place in at
    }
    nothing = places(np.zeros((3, 2)), [])
    assert nothing[FAR].all()
    assert sum(mask.sum() for mask in nothing.values()) == 3


def test_places_are_scored_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "FEWEST", 1)
    one = play("room", SCANS, Fraction(1), draws=2, with_peers=False)
    points = len(labelled_points(split(SCANS)[1], seed=0))
    for method in one.results:
        assert sum(there.points for there in method.there.values()) == points
        at, opened = method.there[AT], method.there[OPEN]
        assert at.occupied > 0.9 > 0.1 > opened.occupied
        assert at.predicted > 0.5 > opened.predicted
        assert opened.auc is None
        for name in ("nll", "brier", "share_unknown"):
            parts = [getattr(there, name) * there.points for there in method.there.values()]
            assert sum(parts) / points == pytest.approx(method.scores[name].mean, abs=1e-12)


def test_places_of_few_points_are_left_out() -> None:
    one = play("room", SCANS, Fraction(1), draws=2, with_peers=False)
    assert all(there.points >= study.FEWEST for r in one.results for there in r.there.values())
    assert all(BEFORE not in r.there for r in one.results)


def test_promises_are_judged_as_stated() -> None:
    rounds = [
        one_round(ALL, 0.08, 0.1), one_round(THIRD, 0.09, 0.11), one_round(TENTH, 0.1, 0.2, 0.05)
    ]  # fmt: skip
    met = {(v.share, v.what): v.met for v in verdicts(rounds)}
    assert met[ALL, "NLL over the grid's"]
    assert not met[THIRD, "NLL over the grid's"]
    assert met[TENTH, "NLL over the grid's"]
    assert met[THIRD, "NLL over the grid's of all scans"]
    assert met[ALL, "ECE"]
    assert not met[TENTH, "ECE"]
    assert all(met[share, "AUC short of the grid's"] for share in (ALL, THIRD, TENTH))


@pytest.mark.parametrize("name", peers.PEERS)
def test_peers_learn_the_room(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, _, build = peers.PEERS[name]
    pytest.importorskip(module)
    monkeypatch.setattr(peers, "HILBERT_FEATURES", 100)
    monkeypatch.setattr(peers, "HILBERT_POINTS", 1000)
    monkeypatch.setattr(peers, "GP_POINTS", 100)
    monkeypatch.setattr(peers, "SPARSE_INDUCING", 50)
    monkeypatch.setattr(peers, "SPARSE_STEPS", 100)
    training, held_out = split(SCANS)
    test = labelled_points(held_out, seed=0, keep=200)
    peer = build(training, 0.1)
    assert peer.facts["memory_bytes"] > 0
    probability, known = peer.predict(test.points)
    assert probability.shape == known.shape == (200,)
    assert probability[test.occupied].mean() > probability[~test.occupied].mean() + 0.3


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "find_spec", lambda _: None)
    assert peers.missing_peers()["OctoMap"] == "octomap-python"
    assert peers.peers(SCANS, 0.1) == []


def test_the_command_writes_tables_and_figures(tmp_path: Path) -> None:
    log, out = room_log(tmp_path / "room.log", SCANS), tmp_path / "out"
    app = typer.Typer()
    app.command()(compare)
    arguments = [str(log), "--shares", "1,1/10", "--draws", "2", "--no-peers", "--output", str(out)]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    document = json.loads((out / "comparison.json").read_text())
    assert [one["share"] for one in document["rounds"]] == ["1", "1/10"]
    assert document["rounds"][0]["methods"][MAP]["nll"]["mean"] < 0.3
    assert document["rounds"][0]["methods"][MAP]["places"][AT]["nll"] < 0.3
    assert f"| room | 1 | {AT} | {MAP} |" in done.stdout
    assert (out / "comparison.md").read_text() == done.stdout
    pytest.importorskip("matplotlib")
    for name in ("learning_curves.png", "reliability.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
