"""The disk fills up: nothing more is acknowledged, questions are answered, it ends by itself."""

import subprocess
import time

import pytest

from service.archive import Archive
from service.clock import SystemClock
from service.map_service import MapService, Ports
from service.sequences import Cursor, SensorKey
from service.settings import JournalSettings, Settings
from service.source import MemorySource
from tests.faults.parts import until
from tests.service.rooms import payload_at

KEY = SensorKey("robot", "front")


@pytest.fixture
def small_disk(tmp_path):
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(tmp_path)],  # noqa: S607
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f"cannot mount a small disk: {mounted.stderr.decode().strip()}")
    yield tmp_path
    subprocess.run(["umount", "-l", str(tmp_path)], check=True)  # noqa: S607


@pytest.mark.timeout(400)
def test_a_full_disk_stops_acknowledgements_and_nothing_else(small_disk) -> None:
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(2**20))
    settings = Settings(journal=JournalSettings(checkpoint_interval_s=3600.0))
    source, acks = MemorySource(), {}
    archive = Archive(small_disk / "data", settings.journal, settings.map, SystemClock())
    service = MapService(settings, Ports(source, archive=archive, acknowledge=acks.update))
    service.start()
    try:
        until(lambda: not service.troubles(), 300.0, "ready")
        seq, none = 0, Cursor(0, 0)
        end = time.monotonic() + 60.0
        while not service.troubles() and time.monotonic() < end:
            seq += 1
            source.put("robot", "front", payload_at(seq=seq, reliable=True))
            until(
                lambda n=seq: bool(service.troubles()) or acks.get(KEY, none).seq == n,
                20.0,
                "stored or refused",
            )
        (trouble,) = service.troubles()
        assert "scans cannot be stored" in trouble
        assert "full" in trouble
        stored = acks[KEY]
        assert stored == Cursor(1, seq - 1), "what is acknowledged is what fitted"
        assert service.state.snapshot.query([[0.0, 0.0]]).known.shape == (1,)
        assert b"gpom_journal_failures_total" in service.metrics.exposition()
        assert service.metrics.registry.get_sample_value("gpom_journal_failures_total") >= 1

        ballast.unlink()
        took_s = until(lambda: not service.troubles(), 20.0, "recovered without a scan")
        source.put("robot", "front", payload_at(seq=seq, reliable=True))
        until(lambda: acks[KEY].seq == seq, 20.0, "the refused scan is taken")
        service.flush().result(60.0)
        assert service.state.scans_integrated == seq
        print(f"disk full scans={seq} lost=0 recovered_after_s={took_s:.1f}")
    finally:
        service.stop()
