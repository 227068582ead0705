"""Where scans wait until the map has stored them: in memory, or on disk.

A store is a queue with a memory of its place in the stream: entry i from the front is scan
`acked + 1 + i` of run `boot`. So numbers need not be kept, and survive a crash with the entries.
"""

import sqlite3
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

from clients.errors import OutboxStorageError
from gpom_core.errors import ConfigurationError

Policy = Literal["block", "drop_oldest"]


@dataclass(frozen=True, slots=True)
class OutboxSettings:
    """How scans wait.

    Attributes:
        scans_max: that may wait.
        bytes_max: of them.
        policy: when it is full, `block` lets `publish` wait, `drop_oldest` drops the oldest scan
            that was not sent yet and counts it.
        block_timeout_s: `publish` then waits no longer; None for ever.
        window: scans on their way that are not acknowledged.
        silence_s: without progress for so long the map is asked where the stream is.
        path: SQLite file that keeps them over a crash of the robot; None for memory only. Each
            stream needs its own.

    Raises:
        ConfigurationError: a number is not positive, or the window is not within `scans_max`.
    """

    scans_max: int = 4096
    bytes_max: int = 256 * 2**20
    policy: Policy = "block"
    block_timeout_s: float | None = None
    window: int = 256
    silence_s: float = 1.0
    path: Path | None = None

    def __post_init__(self) -> None:
        if self.policy not in {"block", "drop_oldest"}:
            message = f"the policy {self.policy!r} is not known; expected block or drop_oldest"
            raise ConfigurationError(message)
        if not (1 <= self.window <= self.scans_max and self.bytes_max > 0 and self.silence_s > 0):
            message = (
                f"an outbox of {self.scans_max} scans, {self.bytes_max} bytes, a window of "
                f"{self.window} and {self.silence_s} s of silence; expected positive numbers and "
                "a window within the scans"
            )
            raise ConfigurationError(message)


class Entry(NamedTuple):
    """A scan that waits; its payload is renumbered when it is sent."""

    ticket: int
    payload: bytes


class Store(Protocol):
    """A queue of entries that knows its place in the stream. Not thread-safe."""

    boot: int
    acked: int
    ticket: int  # of the last entry ever added
    size_bytes: int

    def __len__(self) -> int:
        """Entries that wait."""
        ...

    @property
    def front(self) -> int:
        """Ticket of the first entry; of the next to come when none waits."""
        ...

    def has(self, ticket: int) -> bool:
        """Whether an entry waits."""
        ...

    def dropped(self) -> Iterator[int]:
        """Give the tickets after the front that do not wait, ascending: they were taken out."""
        ...

    def add(self, payload: bytes) -> Entry:
        """Put a scan at the end."""
        ...

    def slice(self, start: int, end: int) -> Sequence[Entry]:
        """Look at entries by their place in the queue."""
        ...

    def remove_front(self, count: int) -> Sequence[Entry]:
        """Take `count` entries that are stored; `acked` grows as much."""
        ...

    def remove_at(self, place: int) -> Entry:
        """Take an entry that was never sent out of the queue."""
        ...

    def restart(self, boot: int) -> None:
        """Begin a new run with what waits, from number 1."""
        ...

    def close(self) -> None:
        """Let go."""


@dataclass(slots=True)
class MemoryStore:
    """Entries that live as long as the process."""

    boot: int
    acked: int = 0
    ticket: int = 0
    size_bytes: int = 0
    _entries: deque[Entry] = field(default_factory=deque, init=False)

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def front(self) -> int:
        """Ticket of the first entry, or of the next to come."""
        return self._entries[0].ticket if self._entries else self.ticket + 1

    def has(self, ticket: int) -> bool:
        """Whether an entry waits."""
        place = bisect_left(self._entries, ticket, key=lambda entry: entry.ticket)
        return place < len(self._entries) and self._entries[place].ticket == ticket

    def dropped(self) -> Iterator[int]:
        """Give the tickets after the front that were taken out."""
        waiting = {entry.ticket for entry in self._entries}
        return (ticket for ticket in range(self.front, self.ticket + 1) if ticket not in waiting)

    def add(self, payload: bytes) -> Entry:
        """Put a scan at the end."""
        self.ticket += 1
        entry = Entry(self.ticket, payload)
        self._entries.append(entry)
        self.size_bytes += len(payload)
        return entry

    def slice(self, start: int, end: int) -> Sequence[Entry]:
        """Look at entries by their place."""
        return [self._entries[place] for place in range(start, min(end, len(self._entries)))]

    def remove_front(self, count: int) -> Sequence[Entry]:
        """Take entries that are stored."""
        taken = [self._entries.popleft() for _ in range(count)]
        self.acked += count
        self.size_bytes -= sum(len(entry.payload) for entry in taken)
        return taken

    def remove_at(self, place: int) -> Entry:
        """Take an entry out."""
        entry = self._entries[place]
        del self._entries[place]
        self.size_bytes -= len(entry.payload)
        return entry

    def restart(self, boot: int) -> None:
        """Begin a new run."""
        self.boot, self.acked = boot, 0

    def close(self) -> None:
        """Forget nothing yet: the entries stay readable."""


_SCHEMA = """
CREATE TABLE IF NOT EXISTS place (
  id INTEGER PRIMARY KEY CHECK (id = 1), stream TEXT NOT NULL, boot TEXT NOT NULL,
  acked INTEGER NOT NULL, ticket INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS entries (ticket INTEGER PRIMARY KEY, payload BLOB NOT NULL);
"""
_FORMAT = 1


class DiskStore(MemoryStore):
    """Entries in a SQLite file as well: every change is durable when it returns.

    Args:
        path: of the file, made if there is none.
        stream: whose scans they are; a file of another stream is refused.
        boot: of the run, if the file is new.
        patience_s: how long another publisher, which may be about to end, has to let go of it.

    Raises:
        OutboxStorageError: the file is damaged, in use, or of another stream.
    """

    __slots__ = ("_db", "_path")

    def __init__(self, path: Path, stream: str, boot: int, patience_s: float = 5.0) -> None:
        super().__init__(boot)
        self._path = path
        try:
            self._db = sqlite3.connect(
                path, timeout=patience_s, isolation_level=None, check_same_thread=False
            )
            try:
                self._open(stream, boot)
            except BaseException:
                self._db.close()
                raise
        except sqlite3.Error as error:
            message = (
                f"the outbox {path} cannot be used: {error}. Nothing in it was changed; is another "
                "publisher using it? If it is damaged, move it away: the scans in it are lost"
            )
            raise OutboxStorageError(message) from error

    def _open(self, stream: str, boot: int) -> None:
        db = self._db
        db.execute("PRAGMA locking_mode = EXCLUSIVE")
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        (version,) = db.execute("PRAGMA user_version").fetchone()
        if version not in {0, _FORMAT}:
            message = f"the outbox {self._path} has format {version}; this gpom reads {_FORMAT}"
            raise OutboxStorageError(message)
        db.execute("BEGIN EXCLUSIVE")
        for statement in _SCHEMA.strip().split(";")[:-1]:
            db.execute(statement)
        db.execute(f"PRAGMA user_version = {_FORMAT}")
        db.execute("INSERT OR IGNORE INTO place VALUES (1, ?, ?, 0, 0)", (stream, str(boot)))
        db.execute("COMMIT")
        row = db.execute("SELECT stream, boot, acked, ticket FROM place").fetchone()
        if row[0] != stream:
            message = f"the outbox {self._path} holds scans of {row[0]}, not of {stream}"
            raise OutboxStorageError(message)
        self.boot, self.acked, self.ticket = int(row[1]), row[2], row[3]
        for ticket, payload in db.execute("SELECT ticket, payload FROM entries ORDER BY ticket"):
            self._entries.append(Entry(ticket, payload))
            self.size_bytes += len(payload)

    def add(self, payload: bytes) -> Entry:
        """Put a scan at the end, durably."""
        ticket = self.ticket + 1
        self._commit(
            ("INSERT INTO entries VALUES (?, ?)", (ticket, payload)),
            ("UPDATE place SET ticket = ?", (ticket,)),
        )
        return MemoryStore.add(self, payload)

    def remove_front(self, count: int) -> Sequence[Entry]:
        """Take entries that are stored by the map."""
        last = self._entries[count - 1].ticket if count else 0
        self._commit(
            ("DELETE FROM entries WHERE ticket <= ?", (last,)),
            ("UPDATE place SET acked = acked + ?", (count,)),
        )
        return MemoryStore.remove_front(self, count)

    def remove_at(self, place: int) -> Entry:
        """Take an entry out."""
        ticket = self._entries[place].ticket
        self._commit(("DELETE FROM entries WHERE ticket = ?", (ticket,)))
        return MemoryStore.remove_at(self, place)

    def restart(self, boot: int) -> None:
        """Begin a new run."""
        self._commit(("UPDATE place SET boot = ?, acked = 0", (str(boot),)))
        MemoryStore.restart(self, boot)

    def close(self) -> None:
        """Close the file; what waits stays in it."""
        self._db.close()

    def _commit(self, *statements: tuple[str, tuple[object, ...]]) -> None:
        try:
            self._db.execute("BEGIN")
            try:
                for sql, values in statements:
                    self._db.execute(sql, values)
                self._db.execute("COMMIT")
            except sqlite3.Error:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            message = f"the outbox {self._path} cannot be written: {error}"
            raise OutboxStorageError(message) from error
