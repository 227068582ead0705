"""`gpom query` and `gpom export` against a stand-in for the map service."""

import csv
import json

import numpy as np
import pytest

from clients.cli import run
from tests.clients.fake_http import STATUS, running_http_map


@pytest.fixture
def fake():
    with running_http_map() as server:
        yield server


def test_one_point_may_be_negative(fake, capsys):
    assert run(["query", "-1.5", "-2", "--url", fake.url]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "map_version": 7,
        "occupancy": 0.5,
        "mean": -1.5,
        "variance": -2.0,
        "known": False,
    }
    assert fake.requests[0]["params"]["fusion"] == "bcm"


@pytest.mark.parametrize(
    "text",
    ["1,2\n-3,4\n", "x,y\n1,2\n-3,4\n", "name, y ,X\na,2,1\nb,4,-3\n\n", "\ufeffx,y\n1,2\n-3,4\n"],
)
def test_points_of_a_csv_print_as_csv(fake, tmp_path, capsys, text):
    (tmp_path / "points.csv").write_text(text, encoding="utf-8")
    assert run(["query", "--points", str(tmp_path / "points.csv"), "--url", fake.url]) == 0
    shown = capsys.readouterr()
    rows = list(csv.DictReader(shown.out.splitlines()))
    assert [(float(row["x"]), float(row["y"])) for row in rows] == [(1.0, 2.0), (-3.0, 4.0)]
    assert [row["known"] for row in rows] == ["1", "0"]
    assert "2 points, map version 7" in shown.err


def test_points_of_an_npy_to_an_npy(fake, tmp_path):
    points = np.array([[1.0, 2.0], [-3.0, 4.0]])
    np.save(tmp_path / "points.npy", points)
    target = tmp_path / "answer.npy"
    flags = ["--points", str(tmp_path / "points.npy"), "-o", str(target), "--fusion", "rbcm"]
    assert run(["query", *flags, "--url", fake.url]) == 0
    answer = np.load(target)
    assert answer.shape == (2, 6)
    np.testing.assert_array_equal(answer[:, :2], points)
    assert fake.requests[0]["params"]["fusion"] == "rbcm"


def test_answers_go_to_a_csv_file(fake, tmp_path, capsys):
    (tmp_path / "points.csv").write_text("1,2\n")
    target = tmp_path / "answer.csv"
    flags = ["--points", str(tmp_path / "points.csv"), "--output", str(target)]
    assert run(["query", *flags, "--url", fake.url]) == 0
    assert target.read_text() == "x,y,occupancy,mean,variance,known\n1.0,2.0,0.5,1.0,2.0,1\n"
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"1\n2\n", "row 1 has 1 columns"),
        ("a.csv", b"x,z\n1,2\n", "its columns are x, z"),
        ("a.csv", b"1,b\n", "no points"),
        ("a.npy", b"junk", "no points"),
        ("a.npy", b"", "no points"),
        ("a.npy", b"\x93NUMPY\x01\x00\x07\x00{[]: 1}", "header cannot be parsed"),
        ("none.csv", None, "No such file"),
    ],
)
def test_files_without_points_are_refused(tmp_path, capsys, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert run(["query", "--points", str(tmp_path / name), "--url", "http://127.0.0.1:9"]) == 2
    assert message in capsys.readouterr().err


def test_an_npy_of_another_shape_is_refused(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.zeros((3, 3)))
    assert run(["query", "--points", str(tmp_path / "a.npy")]) == 2
    assert "(N, 2)" in capsys.readouterr().err


@pytest.mark.parametrize("args", [[], ["1"], ["1", "b"]])
def test_unclear_questions_are_refused(args, capsys):
    assert run(["query", *args, "--url", "http://127.0.0.1:9"]) == 2
    assert "expected" in capsys.readouterr().err


@pytest.mark.parametrize("place", [["1", "2"], ["1"]])
def test_a_place_and_a_file_at_once_are_refused(place, capsys):
    assert run(["query", *place, "--points", "a.csv", "--url", "http://127.0.0.1:9"]) == 2
    assert "either X and Y, or --points FILE, not both" in capsys.readouterr().err


def test_a_refusal_of_the_service_is_the_users_error(fake, capsys):
    fake.refuse("/v1/query", 422, "Bad fusion", "expected bcm, rbcm or poe")
    assert run(["query", "1", "2", "--fusion", "mean", "--url", fake.url]) == 2
    assert capsys.readouterr().err == ("gpom: Bad fusion (HTTP 422): expected bcm, rbcm or poe\n")


def test_no_service_is_a_failure(capsys):
    assert run(["query", "1", "2", "--url", "http://127.0.0.1:9"]) == 1
    assert "cannot be reached" in capsys.readouterr().err


@pytest.mark.parametrize(("suffix", "kind"), [("png", "png"), ("zip", "nav2")])
def test_export_of_the_whole_map(fake, tmp_path, suffix, kind):
    target = tmp_path / f"map.{suffix}"
    assert run(["export", str(target), "--layer", "variance", "--url", fake.url]) == 0
    assert target.read_bytes() == f"a {kind} of variance".encode()
    assert fake.requests[-1]["params"]["bbox"] == "-1.0,-2.0,3.0,4.0"


def test_export_of_a_part_as_numbers(fake, tmp_path):
    target = tmp_path / "map.npy"
    flags = ["--bbox", "-1,-1,1,1", "--resolution", "0.5"]
    assert run(["export", str(target), *flags, "--url", fake.url]) == 0
    assert np.load(target).shape == (4, 4)


def test_an_empty_map_has_nothing_to_export(fake, tmp_path, capsys):
    body = json.dumps({**STATUS, "bounds": None}).encode()
    fake.answers["/v1/status"] = (200, "application/json", body)
    assert run(["export", str(tmp_path / "a.png"), "--url", fake.url]) == 2
    assert "the map is empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["a.jpg"], "expected a name that ends in"),
        (["a.png", "--bbox", "1,2,3"], "xmin,ymin,xmax,ymax"),
        (["no/such/folder/a.png", "--bbox", "0,0,1,1"], "cannot write"),
    ],
)
def test_export_refuses_what_cannot_be(fake, tmp_path, monkeypatch, capsys, flags, message):
    monkeypatch.chdir(tmp_path)
    assert run(["export", *flags, "--url", fake.url]) == 2
    assert message in capsys.readouterr().err
