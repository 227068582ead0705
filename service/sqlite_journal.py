"""The journal in one SQLite file: what `append` stored survives the process and the power.

Write-ahead log, synchronous=FULL, one transaction for each batch. A row holds a scan as it came;
a new file appears under its name only when it is complete, so an empty one is damage.
"""

import logging
import os
import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gpom_core.scan import Pose2D
from service.errors import JournalError
from service.fleet import RobotStatus
from service.journal import ScanRecord, StoredScan
from service.journal_mark import JournalMark
from service.journal_schema import check_format, check_streams, create, upgrade
from service.sequences import Cursor, SensorKey
from service.settings import JournalSettings

logger = logging.getLogger(__name__)

_CHECKED_WHOLE_BYTES = 512 * 2**20  # a larger file is not read through at every start
_DELETED_AT_ONCE = 1024
_PAGE_READ = 500
_EFFECTIVE = os.access in os.supports_effective_ids
_SIGN = 1 << 64  # SQLite's integers are signed


@dataclass(slots=True)
class _News:
    """What a batch changes in the row of a stream."""

    last: ScanRecord
    boot: int | None = None
    seq: int | None = None
    scans: int = 0
    lost: int = 0

    def add(self, record: ScanRecord) -> None:
        if record.scan.seq:
            self.boot, self.seq = _signed(record.boot), _signed(record.scan.seq)
        self.scans += 1
        self.lost += record.lost
        self.last = record

    def row(self) -> tuple[object, ...]:
        pose = self.last.scan.pose
        return (self.boot, self.seq, self.scans, self.lost, self.last.received_unix_s, *pose)


class SqliteJournal:
    """Scans of all robots in the order in which they were accepted."""

    durable = True

    def __init__(self, path: Path, settings: JournalSettings) -> None:
        self.path = path
        self._settings = settings
        self._db: sqlite3.Connection | None = None
        self._lock = threading.Lock()
        self._mark = JournalMark(path.with_suffix(".position"))
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
            if not os.path.lexists(self.path):  # a link to a disk that is away is no new journal
                create(self.path)
            if self.path.stat().st_size == 0:
                raise sqlite3.DatabaseError("the file is empty")
            if not os.access(self.path, os.W_OK, effective_ids=_EFFECTIVE):
                # SQLite would open it, and fail when the first scan comes.
                raise PermissionError("this user may not write to it")
            self._check()
            self._db = self._connect()
            upgrade(self._db)
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
                self._mark.write(self.identity, self._position)
            except (sqlite3.Error, OSError) as error:
                self._abandon()
                message = f"the journal {self.path} cannot be written: {error}"
                raise JournalError(message) from error

    def cursors(self) -> Mapping[SensorKey, Cursor]:
        """Give the last scan of every sensor."""
        return _cursors(self._open())

    def robots(self) -> Sequence[RobotStatus]:
        """Give what is known of every robot whose scans were ever stored."""
        return _robots(self._open())

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
            self._mark.close()
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
        """See that all is there, over a connection that leaves a damaged log as it is."""
        db = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro", uri=True)
        try:
            check_format(db, self.path)
            if self.path.stat().st_size <= _CHECKED_WHOLE_BYTES:
                (verdict,) = db.execute("PRAGMA quick_check(1)").fetchone()
                if verdict != "ok":
                    raise sqlite3.DatabaseError(" ".join(verdict.split()))
            if check_streams(db):
                _cursors(db), _robots(db)  # what cannot be read is told now and not later
            (self.identity,) = db.execute("SELECT id FROM identity").fetchone()
            (self._position,) = db.execute("SELECT ifnull(max(position), 0) FROM scans").fetchone()
            rows = db.execute("SELECT stream, robot, sensor FROM streams NOT INDEXED")
            self._streams = {SensorKey(robot, sensor): stream for stream, robot, sensor in rows}
        finally:
            db.close()
        if (stored := self._mark.read(self.identity)) > self._position:
            raise JournalError(self._short(stored))

    def _write(self, db: sqlite3.Connection, records: Sequence[ScanRecord]) -> None:
        db.execute("BEGIN IMMEDIATE")
        if not records:
            db.execute("UPDATE pulse SET count = count + 1")
        streams = dict(self._streams)
        news: dict[int, _News] = {}
        rows = []
        for position, record in enumerate(records, start=self._position + 1):
            key, scan = SensorKey(record.robot, record.sensor), record.scan
            if key not in streams:
                streams[key] = _new_stream(db, key)
            boot, seq = _signed(record.boot), _signed(scan.seq)
            rows.append((position, streams[key], boot, seq, record.received_unix_s, record.payload))
            news.setdefault(streams[key], _News(record)).add(record)
        db.executemany("INSERT INTO scans VALUES (?, ?, ?, ?, ?, ?)", rows)
        db.executemany(
            "UPDATE streams SET boot = ifnull(?, boot), seq = ifnull(?, seq), scans = scans + ?, "
            "lost = lost + ?, seen_unix_s = ?, x = ?, y = ?, yaw = ? WHERE stream = ?",
            [(*what.row(), stream) for stream, what in news.items()],
        )
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
        if isinstance(error, sqlite3.OperationalError | OSError) and os.path.lexists(self.path):
            return (
                f"the journal {self.path} cannot be opened: {error}; it must be a file that this "
                "user may read and write, on a disk that is there and has some room"
            )
        return (
            f"the journal {self.path} is damaged ({error}); nothing was changed. Restore it from a "
            "backup together with the checkpoints beside it, or move the whole directory away and "
            "start anew; `gpom map import` starts a directory from an exported map"
        )

    def _short(self, stored: int) -> str:
        return (
            f"the journal {self.path} ends at scan {self._position}, but {stored} were stored: its "
            "-wal file was removed, cut or damaged, or it is an older copy; nothing was changed. "
            f"Put back what belongs there, or delete {self._mark.path.name} to go on without the "
            f"{stored - self._position} scans that are missing"
        )

    def _gap(self, after: int) -> str:
        return (
            f"the journal {self.path} does not hold the scan at position {after + 1} any more, and "
            "no checkpoint covers it. Restore the checkpoint files, or move the directory away"
        )


def _cursors(db: sqlite3.Connection) -> dict[SensorKey, Cursor]:
    rows = db.execute("SELECT robot, sensor, boot, seq FROM streams WHERE seq > 0")
    return {
        SensorKey(robot, sensor): Cursor(boot % _SIGN, seq % _SIGN)
        for robot, sensor, boot, seq in rows
    }


def _robots(db: sqlite3.Connection) -> list[RobotStatus]:
    # Beside one max(), SQLite takes the other columns from the row that holds it.
    rows = db.execute(
        "SELECT robot, sum(scans), sum(lost), max(seen_unix_s), x, y, yaw FROM streams "
        "WHERE seen_unix_s IS NOT NULL GROUP BY robot"
    )
    return [
        RobotStatus(robot, scans, lost, seen_unix_s, Pose2D(*pose))
        for robot, scans, lost, seen_unix_s, *pose in rows
    ]


def _new_stream(db: sqlite3.Connection, key: SensorKey) -> int:
    added = db.execute("INSERT INTO streams (robot, sensor, boot, seq) VALUES (?, ?, 0, 0)", key)
    if added.lastrowid is None:
        raise JournalError("SQLite gave a stream no number")
    return added.lastrowid


def _signed(number: int) -> int:
    return number - _SIGN if number >= _SIGN // 2 else number
