import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gpom_core.committee import Fusion as CoreFusion
from gpom_core.errors import InvalidQueryError
from gpom_core.snapshot import Snapshot
from service import points
from service.errors import PayloadTooLargeError, UnsupportedMediaError
from service.points import JSON, NPY, read_npy, read_request, write_answer, write_npy


def _go_on() -> None:
    pass


def _json(value) -> bytes:
    return json.dumps(value).encode()


def test_fusion_rules_are_those_of_the_core() -> None:
    assert set(points.Fusion.__args__) == {rule.name.lower() for rule in CoreFusion}


@given(hnp.arrays(np.float64, st.tuples(st.integers(0, 5), st.just(2)), elements=st.floats()))
def test_npy_round_trips_in_either_order(array) -> None:
    np.testing.assert_array_equal(read_npy(write_npy(array)), array)
    np.testing.assert_array_equal(read_npy(write_npy(np.asfortranarray(array))), array)
    np.testing.assert_array_equal(read_npy(write_npy(array.astype(">f8"))), array)


@given(st.binary(max_size=200) | st.binary(max_size=100).map(lambda tail: b"\x93NUMPY" + tail))
def test_hostile_npy_is_refused(body) -> None:
    with pytest.raises(InvalidQueryError):
        read_npy(body)


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr':'<f8'  \n",
        b"{[]:1}",
        b"{b'descr':'<f8'}",
        b"-" * 9000 + b"1",
        b"{'a':(((",
        b"\xff",
    ],
)
@pytest.mark.parametrize("version", [1, 2, 3])
def test_npy_headers_that_are_no_python_are_refused(version, header) -> None:
    """What Python's parser says of them (TypeError, MemoryError, TokenError) is not for us."""
    size = len(header).to_bytes(2 if version == 1 else 4, "little")
    with pytest.raises(InvalidQueryError, match="no npy file"):
        read_npy(b"\x93NUMPY" + bytes([version, 0]) + size + header)


def test_npy_header_is_not_trusted() -> None:
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 2)}
    np.lib.format.write_array_header_1_0(stream, header)
    with pytest.raises(InvalidQueryError, match="bytes follow"):
        read_npy(stream.getvalue())


@pytest.mark.parametrize(
    "array",
    [np.zeros((3, 2), np.float32), np.zeros((3, 3)), np.zeros(2), np.zeros((3, 2), np.int64)],
)
def test_npy_of_another_kind_is_refused(array) -> None:
    with pytest.raises(InvalidQueryError, match="expected float64"):
        read_npy(write_npy(array))


def test_pickles_are_not_opened() -> None:
    stream = io.BytesIO()
    np.save(stream, np.array([[{}, 1]], dtype=object), allow_pickle=True)
    with pytest.raises(InvalidQueryError):
        read_npy(stream.getvalue())


def test_json_points() -> None:
    request = read_request(_json({"points": [[1, 2.5], [-3, 4]]}), JSON, None)
    np.testing.assert_array_equal(request.points, [[1.0, 2.5], [-3.0, 4.0]])
    assert request.fusion == "bcm"


def test_rule_in_the_body_wins_over_the_one_beside_it() -> None:
    body = {"points": [], "fusion": "rbcm"}
    assert read_request(_json(body), JSON, "poe").fusion == "rbcm"
    assert read_request(_json({"points": []}), JSON, "poe").fusion == "poe"
    assert read_request(write_npy(np.zeros((1, 2))), NPY, "poe").fusion == "poe"


def test_a_question_may_name_its_method() -> None:
    body = {"points": [], "method": "field"}
    assert read_request(_json({"points": []}), JSON, None).method == "exact"
    assert read_request(_json(body), JSON, None, "exact").method == "field"
    assert read_request(write_npy(np.zeros((1, 2))), NPY, None, "field").method == "field"
    with pytest.raises(InvalidQueryError, match="method"):
        read_request(_json({"points": [], "method": "guess"}), JSON, None)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[[1, 2]]",
        b"{}",
        b'{"points": 3}',
        b'{"points": [[1, 2], [3]]}',
        b'{"points": [[1, 2, 3]]}',
        b'{"points": [1, 2]}',
        b'{"points": [["1", "2"]]}',
        b'{"points": [[true, false]]}',
        b'{"points": [[null, 1]]}',
        b'{"points": [[1, {}]]}',
        b'{"points": [[1e999999, 1]], "fusion": "no"}',
        b'{"points": [[' + b"9" * 5000 + b", 1]]}",
        b'{"points": [], "fusion": "best"}',
        b'{"points": [], "extra": 1}',
        b'{"points": ' + b"[" * 5000,
    ],
)
def test_malformed_json_is_refused(body) -> None:
    with pytest.raises(InvalidQueryError):
        read_request(body, JSON, None)


def test_other_rules_beside_npy_are_refused() -> None:
    with pytest.raises(InvalidQueryError, match="fusion"):
        read_request(write_npy(np.zeros((1, 2))), NPY, "best")


@pytest.mark.parametrize("media_type", ["", "text/plain", "application/octet-stream"])
def test_other_media_types_are_refused(media_type) -> None:
    with pytest.raises(UnsupportedMediaError, match=JSON):
        read_request(b"", media_type, None)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_refused(value) -> None:
    request = read_request(write_npy(np.array([[0.0, value]])), NPY, None)
    with pytest.raises(InvalidQueryError):
        points.predict(Snapshot(), request, 10, _go_on)


def test_too_many_points_say_how_many_are_allowed() -> None:
    request = read_request(write_npy(np.zeros((11, 2))), NPY, None)
    with pytest.raises(PayloadTooLargeError, match="at most 10"):
        points.predict(Snapshot(), request, 10, _go_on)


def test_answers_say_the_same_in_both_forms() -> None:
    snapshot = Snapshot()
    request = read_request(_json({"points": [[0, 0], [1, 1]]}), JSON, None)
    prediction = points.predict(snapshot, request, 10, _go_on)
    as_json = json.loads(write_answer(prediction, 7, JSON))
    as_npy = np.load(io.BytesIO(write_answer(prediction, 7, NPY)))
    assert as_json["map_version"] == 7
    assert as_npy.shape == (2, 4)
    assert as_npy.dtype == np.float64
    for column, name in enumerate(("occupancy", "mean", "variance", "known")):
        np.testing.assert_array_equal(as_npy[:, column], as_json[name])
