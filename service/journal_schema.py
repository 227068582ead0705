"""The tables of the journal: made, recognised, and brought to the newest format."""

import os
import sqlite3
import uuid
from contextlib import suppress
from pathlib import Path

from gpom_core import wire
from gpom_core.errors import InvalidScanError
from service.errors import JournalError
from service.journal import UNLIMITED_BEAMS

FORMAT = 2
APPLICATION_ID = 0x47504F4D  # "GPOM"

_SCHEMA = """
PRAGMA page_size = 8192;
PRAGMA auto_vacuum = NONE;
CREATE TABLE identity (id TEXT NOT NULL);
CREATE TABLE streams (
  stream INTEGER PRIMARY KEY, robot TEXT NOT NULL, sensor TEXT NOT NULL,
  boot INTEGER NOT NULL, seq INTEGER NOT NULL, scans INTEGER NOT NULL DEFAULT 0,
  lost INTEGER NOT NULL DEFAULT 0, seen_unix_s REAL, x REAL, y REAL, yaw REAL,
  UNIQUE (robot, sensor)
);
CREATE TABLE scans (
  position INTEGER PRIMARY KEY, stream INTEGER NOT NULL, boot INTEGER NOT NULL,
  seq INTEGER NOT NULL, received_unix_s REAL NOT NULL, payload BLOB NOT NULL
);
CREATE UNIQUE INDEX once ON scans (stream, boot, seq) WHERE seq > 0;
CREATE TABLE pulse (id INTEGER PRIMARY KEY CHECK (id = 1), count INTEGER NOT NULL);
INSERT INTO pulse VALUES (1, 0);
"""
_NEW_IN_2 = (
    "scans INTEGER NOT NULL DEFAULT 0",
    "lost INTEGER NOT NULL DEFAULT 0",
    "seen_unix_s REAL",
    "x REAL",
    "y REAL",
    "yaw REAL",
)
_NUMBER = "('integer', 'real', 'null')"
_KINDS = (
    *((name, "('text')") for name in ("robot", "sensor")),
    *((name, "('integer')") for name in ("boot", "seq", "scans", "lost")),
    *((name, _NUMBER) for name in ("seen_unix_s", "x", "y", "yaw")),
)


def create(path: Path) -> None:
    """Make an empty journal; it appears under its name when it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(f".{uuid.uuid4().hex}.new")
    db = sqlite3.connect(draft, isolation_level=None)
    try:
        db.executescript(_SCHEMA)
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {FORMAT}")
        db.execute("INSERT INTO identity VALUES (?)", (uuid.uuid4().hex,))
    finally:
        db.close()
    draft.rename(path)
    _sync_directory(path.parent)


def check_format(db: sqlite3.Connection, path: Path) -> None:
    """Refuse what is no journal, or one that this program does not know.

    Raises:
        JournalError: says which.
    """
    (application,) = db.execute("PRAGMA application_id").fetchone()
    (version,) = db.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION_ID:
        raise JournalError(f"{path} is no journal of gpom; move it away or name another")
    if not 1 <= version <= FORMAT:
        message = f"{path} has format {version}; this gpom reads 1 to {FORMAT}: use another"
        raise JournalError(message)


def check_streams(db: sqlite3.Connection) -> bool:
    """See that streams are where their scans end; what SQLite's own check does not look at.

    Returns:
        Whether they are of the newest format.

    Raises:
        sqlite3.DatabaseError: one of them is not, or holds what no stream can.
    """
    (version,) = db.execute("PRAGMA user_version").fetchone()
    kinds = _KINDS if version > 1 else _KINDS[:4]
    for name, allowed in kinds:
        strange = f"SELECT 1 FROM streams NOT INDEXED WHERE typeof({name}) NOT IN {allowed}"  # noqa: S608 - ours
        told = db.execute(strange)
        if told.fetchone() is not None:
            raise sqlite3.DatabaseError(f"a stream has a {name} that is none")
    mine = "SELECT 1 FROM scans WHERE stream = s.stream AND seq > 0"  # the index `once` has it
    moved = db.execute(
        "SELECT robot FROM streams AS s WHERE seq != 0 AND "  # noqa: S608 - ours
        f"(EXISTS ({mine}) AND NOT EXISTS ({mine} AND boot = s.boot AND seq = s.seq)"
        f" OR EXISTS ({mine} AND boot = s.boot AND seq > s.seq))"
    )
    if (robot := moved.fetchone()) is not None:
        raise sqlite3.DatabaseError(f"a stream of {robot[0]} does not end where its scans end")
    return bool(version == FORMAT)


def upgrade(db: sqlite3.Connection) -> None:
    """Bring a sound journal of an older format to the newest one, in one transaction."""
    (version,) = db.execute("PRAGMA user_version").fetchone()
    if version == FORMAT:
        return
    db.execute("BEGIN IMMEDIATE")
    try:
        for column in _NEW_IN_2:
            db.execute(f"ALTER TABLE streams ADD COLUMN {column}")
        db.execute(
            "UPDATE streams SET scans = (SELECT count(*) FROM scans WHERE stream = streams.stream)"
        )
        last = db.execute(
            "SELECT stream, received_unix_s, payload, max(position) FROM scans GROUP BY stream"
        )
        for stream, seen_unix_s, payload, _ in last.fetchall():
            with suppress(InvalidScanError):
                pose = wire.decode(payload, max_beams=UNLIMITED_BEAMS).pose
                db.execute(
                    "UPDATE streams SET seen_unix_s = ?, x = ?, y = ?, yaw = ? WHERE stream = ?",
                    (seen_unix_s, *pose, stream),
                )
        db.execute(f"PRAGMA user_version = {FORMAT}")
        db.execute("COMMIT")
    except BaseException:
        db.execute("ROLLBACK")
        raise


def _sync_directory(path: Path) -> None:
    """Make renames within a directory durable."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
