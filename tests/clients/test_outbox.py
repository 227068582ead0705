"""Both stores of an outbox keep the same laws; that on disk also over a crash."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from clients.errors import OutboxStorageError
from clients.outbox import DiskStore, MemoryStore, OutboxSettings
from gpom_core.errors import ConfigurationError


@pytest.fixture(params=["memory", "disk"])
def store(request, tmp_path):
    made = MemoryStore(7) if request.param == "memory" else DiskStore(tmp_path / "o", "r/s", 7)
    yield made
    made.close()


def payloads(store):
    return [entry.payload for entry in store.slice(0, 100)]


def test_first_in_first_out_with_tickets(store):
    assert [store.add(bytes([i])).ticket for i in range(5)] == [1, 2, 3, 4, 5]
    assert (len(store), store.size_bytes, store.boot, store.acked) == (5, 5, 7, 0)
    assert [entry.ticket for entry in store.remove_front(2)] == [1, 2]
    assert store.acked == 2
    assert store.remove_at(1).ticket == 4
    assert payloads(store) == [b"\x02", b"\x04"]
    assert [entry.ticket for entry in store.slice(1, 9)] == [5]
    store.restart(9)
    assert (store.boot, store.acked, len(store), store.size_bytes) == (9, 0, 2, 2)
    assert store.add(b"x").ticket == 6


def test_which_entries_wait_and_which_were_dropped(store):
    assert (store.front, list(store.dropped()), store.has(1)) == (1, [], False)
    for i in range(6):
        store.add(bytes([i]))
    store.remove_front(1)
    for _ in range(2):
        store.remove_at(1)
    assert [ticket for ticket in range(-1, 8) if store.has(ticket)] == [2, 5, 6]
    assert (store.front, list(store.dropped())) == (2, [3, 4])
    store.remove_front(3)
    assert (store.front, list(store.dropped())) == (7, [])


def test_what_is_on_disk_is_there_again(tmp_path):
    store = DiskStore(tmp_path / "o", "r/s", 2**64 - 2)
    for i in range(4):
        store.add(bytes([i]))
    store.remove_front(1)
    store.close()
    again = DiskStore(tmp_path / "o", "r/s", 5)
    assert (again.boot, again.acked, again.ticket, len(again)) == (2**64 - 2, 1, 4, 3)
    assert payloads(again) == [b"\x01", b"\x02", b"\x03"]
    again.close()


def test_files_of_others_in_use_and_damaged_are_refused(tmp_path):
    path = tmp_path / "o"
    store = DiskStore(path, "r/s", 1)
    store.add(b"x")
    with pytest.raises(OutboxStorageError, match="another publisher"):
        DiskStore(path, "r/s", 1, patience_s=0.05)
    store.close()
    with pytest.raises(OutboxStorageError, match="holds scans of r/s, not of other/s"):
        DiskStore(path, "other/s", 1)
    path.write_bytes(b"no database at all, and long enough to be read as one" * 10)
    with pytest.raises(OutboxStorageError, match="damaged"):
        DiskStore(path, "r/s", 1)


def test_who_is_about_to_let_go_of_the_file_is_waited_for(tmp_path):
    store = DiskStore(tmp_path / "o", "r/s", 1)
    store.add(b"x")
    ending = threading.Timer(0.1, store.close)
    ending.start()
    after = DiskStore(tmp_path / "o", "r/s", 2)
    ending.join()
    assert (after.boot, payloads(after)) == (1, [b"x"])
    after.close()


@pytest.mark.parametrize(
    "wrong", [{"policy": "drop_all"}, {"window": 0}, {"scans_max": 5}, {"silence_s": 0.0}]
)
def test_settings_are_checked(wrong):
    with pytest.raises(ConfigurationError):
        OutboxSettings(**wrong)


_WRITER = """
import sys
import threading
from pathlib import Path
from clients.outbox import DiskStore
store = DiskStore(Path(sys.argv[1]), "r/s", 1)
while True:
    print(store.add(b"scan").ticket, flush=True)
"""


def test_what_was_taken_survives_sigkill(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(tmp_path / "o")],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path.cwd())},
    ) as writer:
        for _ in range(30):
            told = int(writer.stdout.readline())
        writer.send_signal(signal.SIGKILL)
        told = max([told, *(int(line) for line in writer.stdout)])
    store = DiskStore(tmp_path / "o", "r/s", 2)
    assert store.ticket >= told
    assert len(store) == store.ticket
    store.close()
