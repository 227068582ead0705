"""The map outlives the process: what was acknowledged is in it again, and answers are the same."""

import json
import re
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.link import Link
from service.archive import Archive, catch_up
from service.calibrating import Calibrating
from service.clock import SystemClock
from service.errors import JournalError, MapFileError, NotReadyError
from service.map_service import MapService, Ports
from service.sequences import Cursor
from service.settings import IngestSettings, JournalSettings, Settings
from service.source import MemorySource
from tests.service.conftest import COMPILE_S
from tests.service.rooms import payload_at

GRID = ((-4.0, -4.0, 4.0, 4.0), 0.2)


class House:
    """A service with a data directory that can be started again and again."""

    def __init__(self, directory: Path, until: Callable[..., None]) -> None:
        self.directory = directory
        self.until = until
        self.settings = Settings(
            data_dir=directory, journal=JournalSettings(checkpoint_interval_s=3600.0)
        )
        self.acks: dict = {}

    def start(self, **map_settings) -> MapService:
        settings = self.settings
        config = MapConfig(**map_settings)
        self.source = MemorySource()
        archive = Archive(self.directory, settings.journal, config, SystemClock())
        ports = Ports(self.source, archive=archive, acknowledge=self.acks.update)
        self.service = MapService(settings.model_copy(update={"map": config}), ports)
        self.service.start()
        self.until(lambda: not self.service.troubles(), COMPILE_S)
        return self.service

    def drive(self, first: int, last: int, **fields) -> None:
        for i in range(first, last + 1):
            place = 1.5 * np.cos(i / 3), 1.5 * np.sin(i / 3)
            self.source.put("robot", "front", payload_at(*place, seq=i, reliable=True, **fields))
        self.service.flush().result(60.0)

    def crash(self) -> None:
        """What SIGKILL leaves: no checkpoint at the end, and the lock is gone."""
        kept = self.directory.with_name("kept")
        shutil.copytree(self.directory, kept, ignore=shutil.ignore_patterns("*.new"))
        self.service.stop()
        shutil.rmtree(self.directory)
        kept.rename(self.directory)


@pytest.fixture
def house(tmp_path, eventually):
    house = House(tmp_path / "data", eventually)
    house.start()
    yield house
    house.service.stop()


def occupancy(service: MapService):
    return service.state.snapshot.grid(*GRID).occupancy


UNSPLIT = {"max_observations": 5000}  # when experts are split depends on when they are trained


def assert_same(after, before) -> None:
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-9)


def test_after_a_stop_the_map_is_exactly_what_it_was(house) -> None:
    house.drive(1, 20)
    before, version = occupancy(house.service), house.service.state.snapshot.version
    house.service.stop()
    assert len(list(house.directory.glob("checkpoint-*"))) == 1
    service = house.start()
    np.testing.assert_allclose(occupancy(service), before, rtol=0, atol=1e-9)
    assert service.state.snapshot.version == version
    assert service.state.scans_integrated == 20
    assert service.cursor("robot", "front") == Cursor(1, 20)
    assert service.cursor("robot", "rear") is None


def test_what_is_exported_is_the_map_that_was_served(house) -> None:
    """A calibration that is not due yet is not made for the export either."""
    for i in range(1, 21):
        place = 1.5 * np.cos(i / 3), 1.5 * np.sin(i / 3)
        house.source.put("robot", "front", payload_at(*place, seq=i, reliable=True))

    def caught_up() -> bool:
        state = house.service.state
        return state.scans_integrated == 20 and not state.dirty

    house.until(caught_up)
    house.service.stop()
    before = occupancy(house.service)
    archive = Archive(house.directory, house.settings.journal, MapConfig(), SystemClock())
    archive.open()
    mapper, position = archive.load()
    assert catch_up(mapper, archive.journal, position) == 0
    archive.close()
    assert_same(mapper.snapshot().grid(*GRID).occupancy, before)


def test_after_a_crash_the_journal_is_integrated_again(house) -> None:
    house.service.stop()
    house.start(**UNSPLIT)
    house.drive(1, 20)
    before = occupancy(house.service)
    house.crash()
    service = house.start(**UNSPLIT)
    assert service.state.scans_integrated == 20
    assert_same(occupancy(service), before)


def kept_link(house) -> Path:
    """Of the last calibration, as soon as it is written."""
    path, link = house.directory / "link.json", house.service.state.snapshot.link
    house.until(lambda: path.exists() and f"{link.weights[0]!r}" in path.read_text())
    return path


def test_after_a_crash_it_answers_by_the_calibration_before(house, monkeypatch) -> None:
    house.drive(1, 20)
    link = house.service.state.snapshot.link
    kept_link(house)
    house.crash()
    monkeypatch.setattr(Calibrating, "begin", lambda *_, **__: None)
    assert house.start().state.snapshot.link == link != Link()


@pytest.mark.parametrize("content", [b"", b"\xff", b"{}", b'{"weights": [1e999]}', None])
def test_a_calibration_that_cannot_be_read_is_made_again(house, content) -> None:
    house.service.stop()
    house.start(**UNSPLIT)
    house.drive(1, 12)
    before, path = occupancy(house.service), kept_link(house)
    house.crash()
    if content is None:  # of another journal
        content = re.sub(rb'"journal":"[^"]*"', b'"journal":"another"', path.read_bytes())
    path.write_bytes(content)
    assert_same(occupancy(house.start(**UNSPLIT)), before)


def test_checkpoint_and_tail_make_the_map(house) -> None:
    house.service.stop()
    house.start(**UNSPLIT)
    house.drive(1, 12)
    house.service.stop()
    house.start(**UNSPLIT)
    house.drive(13, 20)
    before = occupancy(house.service)
    house.crash()
    service = house.start(**UNSPLIT)
    assert service.state.scans_integrated == 20
    assert_same(occupancy(service), before)
    house.drive(20, 25)
    assert service.state.scans_integrated == 25, "scan 20 was known, 21 to 25 were new"
    assert house.acks == {("robot", "front"): Cursor(1, 25)}


def test_experts_may_be_split_otherwise_after_a_crash(house) -> None:
    house.drive(1, 20)
    before, seen = occupancy(house.service), house.service.state.observations
    house.crash()
    service = house.start()
    assert service.state.observations == seen
    assert np.quantile(np.abs(occupancy(service) - before), 0.95) < 0.05


def test_robots_are_what_they_were(house) -> None:
    house.drive(1, 12)
    before = house.service.fleet.robots()
    house.crash()
    service = house.start()
    assert service.fleet.robots() == before
    assert service.scans_received == 12
    house.drive(13, 13)
    (robot,) = service.fleet.robots()
    assert (robot.scans, robot.lost) == (13, 0)


def test_scans_over_a_limit_stay_out_of_the_map_until_it_is_raised(house) -> None:
    house.drive(1, 2)
    house.service.stop()
    house.settings = house.settings.model_copy(update={"ingest": IngestSettings(beams_max=10)})
    house.start()
    house.drive(3, 4)
    assert house.acks == {("robot", "front"): Cursor(1, 4)}
    house.crash()
    service = house.start()
    assert service.state.scans_integrated == 2
    assert service.fleet.robots()[0].refused == {"too_many_beams": 2}
    house.crash()
    house.settings = house.settings.model_copy(update={"ingest": IngestSettings()})
    assert house.start().state.scans_integrated == 4, "they are in the journal"


def test_the_map_is_saved_while_it_runs(house) -> None:
    house.service.stop()
    house.settings = house.settings.model_copy(
        update={"journal": JournalSettings(checkpoint_interval_s=0.05, checkpoints_kept=2)}
    )
    house.start()
    for i in range(1, 6):
        house.drive(i, i)
        house.until(
            lambda i=i: (house.directory / f"checkpoint-{i:020d}.gpom").exists(), timeout_s=10.0
        )
    house.until(lambda: len(list(house.directory.glob("checkpoint-*"))) == 2)
    house.crash()
    assert house.start().state.scans_integrated == 5


def test_reliable_scans_come_in_order_once(house) -> None:
    def put(seq: int, boot: int = 1) -> None:
        house.source.put("robot", "front", payload_at(seq=seq, boot=boot, reliable=True))

    for seq in (2, 1, 1, 3, 2):
        put(seq)
    put(2, boot=5)
    put(1, boot=5)
    put(3)
    house.service.flush().result(60.0)
    assert house.service.state.scans_integrated == 3
    assert house.acks == {("robot", "front"): Cursor(5, 1)}
    exposition = house.service.metrics.exposition().decode()
    for reason, count in (("out_of_order", 2), ("stale", 1), ("old_run", 1)):
        # Scan 2 came early, then late, once each; 3 came early.
        assert f'gpom_scans_refused_total{{reason="{reason}"}}' in exposition, (reason, count)


def test_one_directory_has_one_owner(house) -> None:
    other = Archive(house.directory, JournalSettings(), MapConfig(), SystemClock())
    with pytest.raises(JournalError, match="in use by another gpom"):
        other.open()


def test_nothing_is_answered_while_the_map_is_restored(house, monkeypatch) -> None:
    house.drive(1, 10)
    house.crash()
    monkeypatch.setattr("service.mapping.MapKeeper._read_tail", lambda *_: time.sleep(0.01))
    source = MemorySource()
    archive = Archive(house.directory, JournalSettings(), MapConfig(), SystemClock())
    service = MapService(house.settings, Ports(source, archive=archive))
    service.start()
    try:
        house.until(lambda: any("being restored" in trouble for trouble in service.troubles()))
        with pytest.raises(NotReadyError, match="being restored"):
            _ = service.state
        reply = source.ask(b'{"points": [[0, 0]]}', "application/json").result(10.0)
        assert json.loads(reply.body)["status"] == 503
        assert b"gpom_backlog_scans" in service.metrics.exposition()
    finally:
        service.stop()


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        ("DELETE FROM scans WHERE position = 5", "position 5"),
        ("UPDATE scans SET payload = zeroblob(200) WHERE position = 5", "GPOM"),
    ],
)
def test_a_map_whose_scans_cannot_be_read_is_never_said_to_be_restored(house, harm, told) -> None:
    house.drive(1, 10)
    house.crash()
    db = sqlite3.connect(house.directory / "journal.sqlite")
    db.execute(harm)
    db.commit()
    db.close()
    archive = Archive(house.directory, JournalSettings(), MapConfig(), SystemClock())
    service = MapService(house.settings, Ports(MemorySource(), archive=archive))
    service.start()
    try:
        house.until(lambda: any("cannot be restored" in trouble for trouble in service.troubles()))
        time.sleep(0.3)
        (trouble,) = service.troubles()
        assert told in trouble
        with pytest.raises(NotReadyError, match="cannot be restored"):
            _ = service.state
    finally:
        service.stop()
    assert not list(house.directory.glob("checkpoint-*")), "half a map is not saved"


def test_it_answers_while_a_checkpoint_is_loaded(house, monkeypatch) -> None:
    house.drive(1, 3)
    house.service.stop()
    loading = threading.Event()
    load = Archive.load

    def slowly(self, executor):
        assert loading.wait(30.0)
        return load(self, executor)

    monkeypatch.setattr(Archive, "load", slowly)
    archive = Archive(house.directory, JournalSettings(), MapConfig(), SystemClock())
    service = MapService(house.settings, Ports(MemorySource(), archive=archive))
    starter = threading.Thread(target=service.start)
    starter.start()
    try:
        house.until(lambda: "restored from checkpoint-" in service.troubles()[0])
        with pytest.raises(NotReadyError, match=r"restored from checkpoint-0+3\.gpom, \d+ MB"):
            _ = service.state
        assert b"gpom_journal_position 3" in service.metrics.exposition()
        loading.set()
        house.until(lambda: not service.troubles())
        assert service.state.scans_integrated == 3
    finally:
        loading.set()
        starter.join()
        service.stop()


def refused(house, message: str, **map_settings) -> None:
    before = {path.name: path.read_bytes() for path in house.directory.iterdir()}
    with pytest.raises((MapFileError, JournalError), match=message):
        house.start(**map_settings)
    for name, content in before.items():
        if not name.endswith(("-wal", "-shm")):
            assert (house.directory / name).read_bytes() == content, f"{name} was touched"


def test_damaged_checkpoints_are_refused_with_what_to_do(house) -> None:
    house.drive(1, 3)
    house.service.stop()
    (checkpoint,) = house.directory.glob("checkpoint-*")
    content = bytearray(checkpoint.read_bytes())
    content[len(content) // 2] ^= 1
    checkpoint.write_bytes(content)
    refused(house, r"damaged.*Nothing was changed.*move checkpoint-.* away")
    checkpoint.rename(house.directory / "damaged")
    assert house.start().state.scans_integrated == 3, "the advice works"


def test_other_settings_of_the_map_are_refused_with_what_to_do(house) -> None:
    house.drive(1, 3)
    house.service.stop()
    refused(
        house,
        r"other settings \(map.cell_m: 0.1, map.hit_noise_std: 0.42\). Nothing was changed.*"
        r"set the settings back, or move checkpoint-.* away to integrate all scans",
        cell_m=0.2,
        hit_noise_std=0.5,
        retrain_gain=0.3,
    )


def test_a_map_goes_on_with_other_settings_of_when_to_train(house) -> None:
    house.drive(1, 12)
    before = occupancy(house.service)
    house.service.stop()
    house.start(retrain_gain=0.2, max_observations=40, known_variance_ratio=0.5)
    np.testing.assert_allclose(occupancy(house.service), before, rtol=0, atol=1e-9)
    house.drive(13, 20)
    experts = house.service.state.snapshot.experts()
    assert max(expert.observations for expert in experts) <= 40
    house.service.stop()
    house.start(retrain_gain=0.2)
    assert house.service.state.scans_integrated == 20


def test_what_does_not_belong_together_is_refused(house, tmp_path) -> None:
    house.drive(1, 3)
    house.service.stop()
    journal = house.directory / "journal.sqlite"
    shutil.copy(journal, tmp_path / "old")
    journal.unlink()
    refused(house, "checkpoints but no journal")
    house_two = House(tmp_path / "two", house.until)
    house_two.start()
    house_two.service.stop()
    shutil.copy(house_two.directory / "journal.sqlite", journal)
    refused(house, "belongs to another journal")
    shutil.copy(tmp_path / "old", journal)
    house.start()
