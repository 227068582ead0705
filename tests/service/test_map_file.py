"""Map files round-trip; strangers' files are refused before they cost memory or touch a path."""

import io
import json
import random
import zipfile
import zlib

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.image import dump
from gpom_core.mapper import Mapper
from service.errors import MapFileError
from service.map_file import SavedMap, read_map, write_map
from tests.service.rooms import scan_at

LIMIT = 2**26


@pytest.fixture(scope="module")
def saved() -> SavedMap:
    mapper = Mapper(MapConfig())
    mapper.update(scan_at())
    mapper.train()
    return SavedMap(dump(mapper), MapConfig(cell_m=0.1), "journal-1", 7, 123.5)


@pytest.fixture
def path(tmp_path, saved):
    write_map(tmp_path / "a.gpom", saved, compress=True)
    return tmp_path / "a.gpom"


def rewrite(path, change) -> None:
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    change(contents)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)


@pytest.mark.parametrize("compress", [False, True])
def test_what_is_written_is_read(tmp_path, saved, compress) -> None:
    path = tmp_path / "map.gpom"
    for _ in range(2):  # an older one is replaced
        write_map(path, saved, compress=compress)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.gpom"]
    read = read_map(path, LIMIT)
    assert (read.config, read.journal, read.position, read.saved_unix_s) == (
        saved.config,
        "journal-1",
        7,
        123.5,
    )
    assert set(read.image) == set(saved.image)
    for name, array in saved.image.items():
        np.testing.assert_array_equal(read.image[name], array)
        assert read.image[name].dtype == array.dtype
        assert read.image[name].flags.writeable, "else kernels are compiled once more"


def test_the_same_map_gives_the_same_bytes(tmp_path, saved) -> None:
    for name in "ab":
        write_map(tmp_path / name, saved, compress=True)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("where", [0.1, 0.3, 0.6, -30])
def test_one_wrong_byte_is_noticed(path, where) -> None:
    content = bytearray(path.read_bytes())
    at = int(where * len(content)) if isinstance(where, float) else where
    content[at] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(MapFileError):
        read_map(path, LIMIT)


@pytest.mark.parametrize("compress", [False, True])
def test_a_bit_turned_anywhere_is_noticed_or_says_nothing(tmp_path, saved, compress) -> None:
    path, rng = tmp_path / "map.gpom", random.Random(1)
    write_map(path, saved, compress=compress)
    content = path.read_bytes()
    noticed = 0
    for _ in range(100):
        bit = rng.randrange(8 * len(content))
        wrong = bytearray(content)
        wrong[bit // 8] ^= 1 << bit % 8
        path.write_bytes(wrong)
        try:
            read = read_map(path, LIMIT)
        except MapFileError:
            noticed += 1
            continue
        assert (read.config, read.journal, read.position) == (saved.config, "journal-1", 7), bit
        for name, array in saved.image.items():
            np.testing.assert_array_equal(read.image[name], array, err_msg=str(bit))
    assert noticed > 60, "the others are in dates and other notes of the archive"


def test_a_file_that_was_cut_is_noticed(path) -> None:
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(MapFileError, match="damaged or no map file"):
        read_map(path, LIMIT)
    path.write_bytes(b"")
    with pytest.raises(MapFileError):
        read_map(path, LIMIT)


def test_an_archive_that_unpacks_to_too_much_is_refused_unread(path) -> None:
    def inflate(contents) -> None:
        contents["row_near.npy"] = bytes(2 * LIMIT)

    rewrite(path, inflate)
    assert path.stat().st_size < LIMIT / 50
    with pytest.raises(MapFileError, match=r"unpacks to .* at most"):
        read_map(path, LIMIT)


def test_sizes_that_lie_are_noticed(path) -> None:
    """The size in the directory is small, the stream goes on and on."""
    bomb = zlib.compressobj(9, zlib.DEFLATED, -15)
    stream = bomb.compress(bytes(2**24)) + bomb.flush()
    content = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        entry = archive.getinfo("row_near.npy")
        start = content.index(b"row_near.npy", entry.header_offset) + len("row_near.npy")
    broken = content[:start] + stream + content[start + len(stream) :]
    path.write_bytes(broken)
    with pytest.raises(MapFileError):
        read_map(path, LIMIT)


def test_a_header_that_claims_a_huge_array_takes_no_memory(path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    )
    rewrite(path, lambda contents: contents.update({"row_near.npy": header.getvalue()}))
    with pytest.raises(MapFileError, match="does not fit its size"):
        read_map(path, LIMIT)


@pytest.mark.parametrize("header", [b"{'descr':'<f8'  \n", b"{[]:1}", b"{'a':((("])
def test_a_header_that_is_no_python_is_damage(path, header) -> None:
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    rewrite(path, lambda contents: contents.update({"link.npy": content}))
    with pytest.raises(MapFileError, match=r"damaged or no map file: link\.npy"):
        read_map(path, LIMIT)


def test_objects_are_never_unpickled(path) -> None:
    content = io.BytesIO()
    np.save(content, np.array([{"a": 1}], object), allow_pickle=True)
    rewrite(path, lambda contents: contents.update({"row_near.npy": content.getvalue()}))
    with pytest.raises(MapFileError):
        read_map(path, LIMIT)


@pytest.mark.parametrize("name", ["../../etc/cron.d/x", "/etc/passwd", "..\\x.npy", "x.npy"])
def test_names_that_are_not_ours_are_refused(path, tmp_path, name) -> None:
    rewrite(path, lambda contents: contents.update({name: b"evil"}))
    with pytest.raises(MapFileError, match="missing, repeated or unknown"):
        read_map(path, LIMIT)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.gpom"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format 2"),
        ({"kind": "other"}, "manifest"),
        ({"map": {"cell_m": -1}}, "settings of the map"),
        ({"map": {"no_such": 1}}, "settings of the map"),
        ({"extra": 1}, "manifest"),
    ],
)
def test_manifests_are_checked(path, change, message) -> None:
    def edit(contents) -> None:
        contents["manifest.json"] = json.dumps(
            json.loads(contents["manifest.json"]) | change
        ).encode()

    rewrite(path, edit)
    with pytest.raises(MapFileError, match=message):
        read_map(path, LIMIT)


def test_what_is_not_there_is_told(tmp_path, saved) -> None:
    with pytest.raises(MapFileError, match="No such file"):
        read_map(tmp_path / "no", LIMIT)
    with pytest.raises(MapFileError, match="cannot write"):
        write_map(tmp_path / "no" / "map", saved, compress=False)
