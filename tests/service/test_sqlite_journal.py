"""What is appended is there after a crash, once, as it came; damage is told and left alone."""

import os
import random
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from gpom_core import wire
from gpom_core.errors import InvalidScanError
from gpom_core.scan import Pose2D
from service.errors import JournalError
from service.fleet import RobotStatus
from service.journal import ScanRecord
from service.sequences import Cursor, SensorKey
from service.settings import JournalSettings
from service.sqlite_journal import SqliteJournal
from tests.service.rooms import payload_at


def record(
    seq: int = 1,
    *,
    robot: str = "r",
    sensor: str = "front",
    boot: int = 1,
    unix_s: float = 1000.5,
    lost: int = 0,
    **fields,
) -> ScanRecord:
    payload = payload_at(seq=seq, boot=boot, **fields)
    return ScanRecord(robot, sensor, payload, unix_s, wire.decode(payload), boot, lost)


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "data" / "journal.sqlite"


def opened(path: Path, **settings) -> SqliteJournal:
    journal = SqliteJournal(path, JournalSettings(**settings))
    journal.open()
    return journal


def test_scans_come_back_as_they_were_after_reopening(path) -> None:
    journal = opened(path)
    journal.append([record(1), record(2), record(0)])
    journal.append([record(1, robot="other", boot=2**63 - 2)])
    journal.close()
    journal = opened(path)
    assert journal.position == 4
    assert journal.cursors() == {
        SensorKey("r", "front"): Cursor(1, 2),
        SensorKey("other", "front"): Cursor(2**63 - 2, 1),
    }
    stored = list(journal.replay(1, 4))
    assert [scan.position for scan in stored] == [2, 3, 4]
    assert stored[0].payload == record(2).payload
    assert (stored[2].robot, stored[2].sensor, stored[2].received_unix_s) == (
        "other",
        "front",
        1000.5,
    )
    journal.append([record(3)])
    assert journal.position == 5
    journal.close()
    journal.close()


def test_a_batch_is_stored_whole_or_not_at_all(path) -> None:
    journal = opened(path)
    journal.append([record(1)])
    with pytest.raises(JournalError, match="UNIQUE"):
        journal.append([record(2), record(1)])
    assert journal.position == 1
    assert journal.cursors() == {SensorKey("r", "front"): Cursor(1, 1)}
    journal.append([record(2)])  # it recovers by itself
    assert [scan.position for scan in journal.replay(0, 2)] == [1, 2]
    journal.close()


def test_it_is_as_durable_as_sqlite_can_be(path) -> None:
    journal = opened(path)
    db = journal._open()
    assert db.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    assert db.execute("PRAGMA synchronous").fetchone() == (2,)
    journal.close()


def test_the_oldest_scans_in_a_checkpoint_make_room(path) -> None:
    journal = opened(path, size_bytes_max=2**20)
    batch, seq = 50, 0
    released = 0
    while released < 3000:
        records = [record(seq + i + 1) for i in range(batch)]
        journal.append(records)
        seq += batch
        released = seq
        journal.release(released)
    assert journal.bytes_used() <= 2**20 + 2 * batch * 1024
    assert path.stat().st_size < 2 * 2**20
    with pytest.raises(JournalError, match="position 1 any more"):
        list(journal.replay(0, seq))
    assert len(list(journal.replay(seq - 100, seq))) == 100
    journal.close()
    assert opened(path).position == seq


@pytest.mark.parametrize("retention", ["keep", "drop_oldest"])
def test_at_the_limit_nothing_is_deleted_that_is_needed(path, retention) -> None:
    journal = opened(path, size_bytes_max=2**20, retention=retention)
    stored = 0
    if retention == "keep":
        journal.release(10**6)

    def fill() -> None:
        nonlocal stored
        for seq in range(1, 5000, 50):
            journal.append([record(seq + i) for i in range(50)])
            stored += 50

    with pytest.raises(JournalError, match="reached its limit"):
        fill()
    assert len(list(journal.replay(0, stored))) == stored
    journal.close()


def damage(path: Path, kind: str) -> None:
    content = bytearray(path.read_bytes())
    match kind:
        case "empty":
            content = bytearray()
        case "cut":
            content = content[: len(content) // 2]
        case "header":
            content[:16] = b"x" * 16
        case "middle":
            content[8192 * 3 : 8192 * 9] = os.urandom(8192 * 6)
    path.write_bytes(content)


@pytest.mark.parametrize("kind", ["empty", "cut", "header", "middle"])
def test_damage_is_told_with_what_to_do_and_left_as_it_is(path, kind) -> None:
    journal = opened(path)
    for seq in range(1, 200):
        journal.append([record(seq)])
    journal.close()
    damage(path, kind)
    before = path.read_bytes()
    with pytest.raises(JournalError, match=r"is damaged.*nothing was changed.*backup"):
        opened(path)
    assert path.read_bytes() == before


def killed(path: Path) -> dict[str, bytes]:
    """What SIGKILL leaves of a journal of 40 scans: most of it in the write-ahead log."""
    journal = opened(path)
    for seq in range(1, 41):
        journal.append([record(seq)])
    kept = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    journal.close()
    for name, content in kept.items():
        (path.parent / name).write_bytes(content)
    return kept


def test_what_a_killed_process_left_in_the_log_is_there(path) -> None:
    killed(path)
    assert opened(path).position == 40


@pytest.mark.parametrize("harm", ["removed", "cut", "flipped"])
def test_a_log_that_lost_scans_is_told_and_left_as_it_is(path, harm) -> None:
    log = path.with_name("journal.sqlite-wal")
    content = killed(path)[log.name]
    middle = len(content) // 2
    if harm == "removed":
        log.unlink()
    elif harm == "cut":
        log.write_bytes(content[:middle])
    else:
        log.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    before = {file: file.read_bytes() for file in (path, log) if file.exists()}
    told = r"ends at scan \d+, but 40 were stored.*nothing was changed.*delete journal.position"
    with pytest.raises(JournalError, match=told):
        opened(path)
    assert {file: file.read_bytes() for file in before} == before
    path.with_name("journal.position").unlink()
    journal = opened(path)
    assert 0 <= journal.position < 40, "the advice works"
    journal.append([record(41)])
    journal.close()
    assert opened(path).position == journal.position


def test_a_mark_of_another_journal_or_none_says_nothing(path) -> None:
    mark = path.with_name("journal.position")
    opened(path).close()
    assert not mark.exists()
    for content in (b"", b"nonsense", b"0" * 32 + b" 00000000000000000009\n"):
        mark.write_bytes(content)
        journal = opened(path)
        assert mark.read_bytes() == content, "nothing is stored yet"
        journal.append([record(journal.position + 1)])
        journal.close()
        assert mark.read_bytes() == f"{journal.identity} {journal.position:020d}\n".encode()


def test_a_bit_turned_anywhere_is_told_or_says_nothing_of_scans(path) -> None:
    """Of what is not a scan, only names and counts of robots have no sum to hold them against."""
    journal, rng = opened(path), random.Random(1)
    for seq in range(1, 60):
        journal.append([record(seq, robot=robot) for robot in "abc"])

    def told(journal: SqliteJournal) -> tuple[object, ...]:
        scans = list(journal.replay(0, journal.position))
        for scan in scans:
            wire.decode(scan.payload)
        return [scan.payload for scan in scans], sorted(journal.cursors().values())

    before = told(journal)
    journal.close()
    content, noticed = path.read_bytes(), 0
    for _ in range(100):
        bit = rng.randrange(8 * len(content))
        wrong = bytearray(content)
        wrong[bit // 8] ^= 1 << bit % 8
        path.write_bytes(wrong)
        try:
            journal = opened(path)
        except JournalError:
            noticed += 1
            continue
        try:
            assert told(journal) == before, bit
        except (JournalError, InvalidScanError):
            noticed += 1
        finally:
            journal.close()
    assert noticed > 50, "the others are in unused space"


@pytest.mark.parametrize(
    "harm",
    [
        "UPDATE streams SET seq = 5 WHERE robot = 'r'",  # scans sent again would be in the way
        "UPDATE streams SET seq = 50 WHERE robot = 'r'",  # scans that never came would be let go
        "UPDATE streams SET boot = 3 WHERE robot = 'r'",
        "UPDATE streams SET x = 'west' WHERE robot = 'r'",
        "UPDATE streams SET robot = x'ff' WHERE robot = 'r'",
    ],
)
def test_streams_that_do_not_end_where_their_scans_end_are_told(path, harm) -> None:
    journal = opened(path)
    journal.append([*(record(seq) for seq in range(1, 11)), record(1, robot="other", boot=2)])
    journal.close()
    db = sqlite3.connect(path, isolation_level=None)
    db.execute(harm)
    db.close()
    with pytest.raises(JournalError, match=r"is damaged \(a stream .*nothing was changed"):
        opened(path)


def test_other_files_and_formats_are_refused(path) -> None:
    path.parent.mkdir()
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE mine (x)")
    db.commit()
    db.close()
    with pytest.raises(JournalError, match="no journal of gpom"):
        opened(path)
    path.unlink()
    opened(path).close()
    db = sqlite3.connect(path)
    db.execute("PRAGMA user_version = 9")
    db.close()
    with pytest.raises(JournalError, match="format 9"):
        opened(path)


def test_robots_are_known_after_reopening(path) -> None:
    journal = opened(path)
    journal.append([record(1, x=0.5), record(4, x=1.0, unix_s=1002.0, lost=2)])
    journal.append([record(0, sensor="rear", x=2.0, unix_s=1003.0), record(1, robot="other")])
    journal.append([record(1, boot=2, x=1.5, unix_s=1001.0)])
    journal.close()
    journal = opened(path)
    other, robot = sorted(journal.robots(), key=lambda robot: robot.id)
    assert robot == RobotStatus("r", 4, 2, 1003.0, Pose2D(2.0, 0.0, 0.0))
    assert (other.id, other.scans) == ("other", 1)
    assert set(journal.cursors()) == {("r", "front"), ("other", "front")}, "rear is not numbered"
    journal.close()


_FORMAT_1 = """
DROP TABLE streams;
CREATE TABLE streams (
  stream INTEGER PRIMARY KEY, robot TEXT NOT NULL, sensor TEXT NOT NULL,
  boot INTEGER NOT NULL, seq INTEGER NOT NULL, UNIQUE (robot, sensor)
);
INSERT INTO streams VALUES (1, 'r', 'front', 1, 2);
PRAGMA user_version = 1;
"""


def test_a_journal_of_the_first_format_is_brought_to_the_newest(path) -> None:
    journal = opened(path)
    journal.append([record(1), record(2, x=0.5)])
    journal.close()
    db = sqlite3.connect(path)
    db.executescript(_FORMAT_1)
    db.close()
    for _ in range(2):
        journal = opened(path)
        assert journal.robots() == [RobotStatus("r", 2, 0, 1000.5, Pose2D(0.5, 0.0, 0.0))]
        assert journal.cursors() == {SensorKey("r", "front"): Cursor(1, 2)}
        journal.close()


def test_a_file_that_goes_away_is_not_made_anew(path) -> None:
    journal = opened(path)
    journal.close()
    path.unlink()
    with pytest.raises(JournalError, match="cannot be written"):
        journal.append([record(1)])
    assert not path.exists()


_WRITER = """
import sys
from pathlib import Path
from tests.service.test_sqlite_journal import opened, record
journal = opened(Path(sys.argv[1]))
seq = journal.position
while True:
    journal.append([record(seq + 1), record(seq + 2)])
    seq += 2
    print(seq, flush=True)
"""


def test_what_was_appended_survives_sigkill(path) -> None:
    for _ in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", _WRITER, str(path)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[2],
        ) as writer:
            told = 0
            for _ in range(20):
                told = int(writer.stdout.readline())
            writer.send_signal(signal.SIGKILL)
            told = max([told, *(int(line) for line in writer.stdout)])
        journal = opened(path)
        assert journal.position >= told
        assert journal.position % 2 == 0, "a batch is there whole or not at all"
        assert len(list(journal.replay(0, journal.position))) == journal.position
        journal.close()
