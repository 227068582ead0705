"""The journal in one SQLite file: what `append` stored survives the process and the power.

Write-ahead log, synchronous=FULL, one transaction for each batch. A row holds a scan as it came;
a new file appears under its name only when it is complete, so an empty one is damage.
"""

import logging
import os
import sqlite3
import threading
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from service.errors import JournalError
from service.journal import ScanRecord, StoredScan
from service.sequences import Cursor, SensorKey
from service.settings import JournalSettings

logger = logging.getLogger(__name__)

FORMAT = 1
_APPLICATION_ID = 0x47504F4D  # "GPOM"
_CHECKED_WHOLE_BYTES = 512 * 2**20  # a larger file is not read through at every start
_DELETED_AT_ONCE = 1024
_PAGE_READ = 500
_SIGN = 1 << 64  # SQLite's integers are signed

_SCHEMA = """
PRAGMA page_size = 8192;
PRAGMA auto_vacuum = NONE;
CREATE TABLE identity (id TEXT NOT NULL);
CREATE TABLE streams (
  stream INTEGER PRIMARY KEY, robot TEXT NOT NULL, sensor TEXT NOT NULL,
  boot INTEGER NOT NULL, seq INTEGER NOT NULL, UNIQUE (robot, sensor)
);
CREATE TABLE scans (
  position INTEGER PRIMARY KEY, stream INTEGER NOT NULL, boot INTEGER NOT NULL,
  seq INTEGER NOT NULL, received_unix_s REAL NOT NULL, payload BLOB NOT NULL
);
CREATE UNIQUE INDEX once ON scans (stream, boot, seq) WHERE seq > 0;
CREATE TABLE pulse (id INTEGER PRIMARY KEY CHECK (id = 1), count INTEGER NOT NULL);
INSERT INTO pulse VALUES (1, 0);
"""


class SqliteJournal:
    """Scans of all robots in the order in which they were accepted."""

    durable = True

    def __init__(self, path: Path, settings: JournalSettings) -> None:
        self.path = path
        self._settings = settings
        self._db: sqlite3.Connection | None = None
        self._lock = threading.Lock()
        self._streams: dict[SensorKey, int] = {}
        self._position = 0
        self._released = 0
        self.identity = ""

    @property
    def position(self) -> int:
        """Of the last scan that was stored."""
        return self._position

    def open(self) -> None:
        """Create the file if there is none, and check it if there is one.

        Raises:
            JournalError: it is damaged, of another format, or cannot be written.
        """
        try:
            if not self.path.exists():
                _create(self.path)
            if self.path.stat().st_size == 0:
                raise sqlite3.DatabaseError("the file is empty")
            self._db = self._connect()
            self._check()
        except (sqlite3.Error, OSError) as error:
            self.close()
            raise JournalError(self._explain(error)) from error
        except JournalError:
            self.close()
            raise

    def append(self, records: Sequence[ScanRecord]) -> None:
        """Store all of them or none, durably.

        Raises:
            JournalError: disk full, I/O error, or the size limit is reached.
        """
        with self._lock:
            try:
                self._make_room()
                self._write(self._open(), records)
            except (sqlite3.Error, OSError) as error:
                self._abandon()
                message = f"the journal {self.path} cannot be written: {error}"
                raise JournalError(message) from error

    def cursors(self) -> Mapping[SensorKey, Cursor]:
        """Give the last scan of every sensor."""
        rows = self._open().execute("SELECT robot, sensor, boot, seq FROM streams WHERE seq > 0")
        return {
            SensorKey(robot, sensor): Cursor(boot % _SIGN, seq % _SIGN)
            for robot, sensor, boot, seq in rows
        }

    def replay(self, after: int, until: int) -> Iterator[StoredScan]:
        """Read scans with `after` < position <= `until`, over a connection of its own.

        Raises:
            JournalError: some are missing or unreadable.
        """
        try:
            reader = self._connect()
            try:
                while after < until:
                    batch = reader.execute(
                        "SELECT position, robot, sensor, payload, received_unix_s FROM scans "
                        "JOIN streams USING (stream) WHERE position > ? AND position <= ? "
                        "ORDER BY position LIMIT ?",
                        (after, until, _PAGE_READ),
                    ).fetchall()
                    for row in batch:
                        stored = StoredScan(*row)
                        if stored.position != after + 1:
                            break
                        yield stored
                        after = stored.position
                    else:
                        if batch:
                            continue
                    raise JournalError(self._gap(after))
            finally:
                reader.close()
        except sqlite3.Error as error:
            raise JournalError(self._explain(error)) from error

    def release(self, position: int) -> None:
        """Let scans up to `position` be deleted when the size limit is reached."""
        self._released = position

    def bytes_used(self) -> int:
        """Size of what is stored, without pages that can be used again."""
        db = self._open()
        (pages,) = db.execute("PRAGMA page_count").fetchone()
        (free,) = db.execute("PRAGMA freelist_count").fetchone()
        (size,) = db.execute("PRAGMA page_size").fetchone()
        return int((pages - free) * size)

    def close(self) -> None:
        """Close the file; the write-ahead log is merged into it."""
        with self._lock:
            db, self._db = self._db, None
            if db is not None:
                db.close()

    def _open(self) -> sqlite3.Connection:
        self._db = self._db or self._connect()
        return self._db

    def _connect(self) -> sqlite3.Connection:
        # Opened by URI so that a file which has gone is not made anew, empty.
        uri = f"{self.path.absolute().as_uri()}?mode=rw"
        db = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
        try:
            db.execute("PRAGMA busy_timeout = 5000")
            (mode,) = db.execute("PRAGMA journal_mode = WAL").fetchone()
            if mode != "wal":
                message = (
                    f"{self.path} lies on a file system without write-ahead logs (a network "
                    "share?); expected a local disk"
                )
                raise JournalError(message)
            db.execute("PRAGMA synchronous = FULL")
        except BaseException:
            db.close()
            raise
        return db

    def _check(self) -> None:
        db = self._open()
        (application,) = db.execute("PRAGMA application_id").fetchone()
        (version,) = db.execute("PRAGMA user_version").fetchone()
        if application != _APPLICATION_ID:
            raise JournalError(f"{self.path} is no journal of gpom; move it away or name another")
        if version != FORMAT:
            message = f"{self.path} has format {version}; this gpom reads {FORMAT}: use another"
            raise JournalError(message)
        if self.path.stat().st_size <= _CHECKED_WHOLE_BYTES:
            (verdict,) = db.execute("PRAGMA quick_check(1)").fetchone()
            if verdict != "ok":
                raise sqlite3.DatabaseError(" ".join(verdict.split()))
        (self.identity,) = db.execute("SELECT id FROM identity").fetchone()
        (self._position,) = db.execute("SELECT ifnull(max(position), 0) FROM scans").fetchone()
        self._streams = {
            SensorKey(robot, sensor): stream
            for stream, robot, sensor in db.execute("SELECT stream, robot, sensor FROM streams")
        }

    def _write(self, db: sqlite3.Connection, records: Sequence[ScanRecord]) -> None:
        db.execute("BEGIN IMMEDIATE")
        if not records:
            db.execute("UPDATE pulse SET count = count + 1")
        streams, cursors = dict(self._streams), {}
        rows = []
        for position, record in enumerate(records, start=self._position + 1):
            key, scan = SensorKey(record.robot, record.sensor), record.scan
            if key not in streams:
                streams[key] = _new_stream(db, key)
            boot, seq = _signed(scan.boot), _signed(scan.seq)
            rows.append((position, streams[key], boot, seq, record.received_unix_s, record.payload))
            if scan.seq:
                cursors[streams[key]] = (boot, seq, streams[key])
        db.executemany("INSERT INTO scans VALUES (?, ?, ?, ?, ?, ?)", rows)
        db.executemany("UPDATE streams SET boot = ?, seq = ? WHERE stream = ?", cursors.values())
        db.execute("COMMIT")
        self._position += len(records)
        self._streams = streams

    def _make_room(self) -> None:
        limit = self._settings.size_bytes_max
        if self.bytes_used() < limit:
            return
        if self._settings.retention == "drop_oldest":
            # The last one stays: its position is where numbering goes on.
            end = min(self._released, self._position - 1)
            deleted = self._open().execute(
                "DELETE FROM scans WHERE position IN "
                "(SELECT position FROM scans WHERE position <= ? ORDER BY position LIMIT ?)",
                (end, _DELETED_AT_ONCE),
            )
            if deleted.rowcount > 0:
                return
        message = (
            f"the journal {self.path} has reached its limit of {limit} bytes and nothing in it may "
            f"be deleted (retention is {self._settings.retention}); raise journal.size_bytes_max"
        )
        raise JournalError(message)

    def _abandon(self) -> None:
        """Roll back by closing: after an I/O error a connection is not to be trusted."""
        db, self._db = self._db, None
        if db is None:
            return
        try:
            db.close()
        except sqlite3.Error:
            logger.debug("closing the journal after an error failed", exc_info=True)

    def _explain(self, error: Exception) -> str:
        if isinstance(error, sqlite3.OperationalError | OSError) and self.path.exists():
            return f"the journal {self.path} cannot be opened: {error}"
        return (
            f"the journal {self.path} is damaged ({error}); nothing was changed. Restore it from a "
            "backup together with the checkpoints beside it, or move the whole directory away and "
            "start anew; `gpom map import` starts a directory from an exported map"
        )

    def _gap(self, after: int) -> str:
        return (
            f"the journal {self.path} does not hold the scan at position {after + 1} any more, and "
            "no checkpoint covers it. Restore the checkpoint files, or move the directory away"
        )


def _create(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(f".{uuid.uuid4().hex}.new")
    db = sqlite3.connect(draft, isolation_level=None)
    try:
        db.executescript(_SCHEMA)
        db.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {FORMAT}")
        db.execute("INSERT INTO identity VALUES (?)", (uuid.uuid4().hex,))
    finally:
        db.close()
    draft.rename(path)
    sync_directory(path.parent)


def sync_directory(path: Path) -> None:
    """Make renames within a directory durable."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _new_stream(db: sqlite3.Connection, key: SensorKey) -> int:
    added = db.execute("INSERT INTO streams (robot, sensor, boot, seq) VALUES (?, ?, 0, 0)", key)
    if added.lastrowid is None:
        raise JournalError("SQLite gave a stream no number")
    return added.lastrowid


def _signed(number: int) -> int:
    return number - _SIGN if number >= _SIGN // 2 else number
