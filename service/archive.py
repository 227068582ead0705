"""The data directory: the journal, and checkpoints of the map, used by one process at a time.

A restart loads the newest checkpoint and integrates the scans that the journal holds beyond it.
What is damaged or does not belong together is refused, with what to do; nothing is ever emptied.
"""

import fcntl
import logging
import os
from collections.abc import Mapping
from concurrent.futures import Executor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from gpom_core import wire
from gpom_core.config import MapConfig
from gpom_core.errors import GpomError, InvalidScanError
from gpom_core.image import dump, load
from gpom_core.link import Link
from gpom_core.mapper import Mapper
from service.clock import Clock
from service.errors import JournalError, MapFileError
from service.journal import UNLIMITED_BEAMS, Journal
from service.map_file import SavedMap, read_map, write_map
from service.settings import JournalSettings
from service.sqlite_journal import SqliteJournal

logger = logging.getLogger(__name__)

_PATTERN = "checkpoint-*.gpom"


class _KeptLink(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    journal: str
    position: int
    weights: tuple[float, ...]
    map: dict[str, Any]


class Archive:
    """What outlives the process.

    Args:
        directory: made if it does not exist.
        settings: of the journal and the checkpoints.
        config: of the map; checkpoints of one whose evidence means something else are refused.
        clock: tells when a checkpoint was saved.
        site: key prefix of the robots whose map it is; None for who takes no scans in.
    """

    def __init__(
        self,
        directory: Path,
        settings: JournalSettings,
        config: MapConfig,
        clock: Clock,
        site: str | None = None,
    ) -> None:
        self.directory = directory
        self.journal = SqliteJournal(directory / "journal.sqlite", settings)
        self._settings = settings
        self._config = config
        self._clock = clock
        self._site = site
        self._lock: int | None = None

    def open(self) -> None:
        """Lock the directory and open the journal.

        Raises:
            JournalError: another process uses it, or the journal cannot be used.
        """
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.directory / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        except (OSError, ValueError) as error:
            raise JournalError(self._unusable(error)) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            message = (
                f"the data directory {self.directory} is in use by another gpom; stop it first"
            )
            raise JournalError(message) from error
        try:
            if not self.journal.path.exists() and self.checkpoints():
                message = (
                    f"{self.directory} has checkpoints but no journal.sqlite. Put the journal "
                    "back, or import the newest checkpoint into an empty directory with "
                    "`gpom map import`"
                )
                raise JournalError(message)
            self.journal.open()
            self._check_site()
        except JournalError:
            self.close()
            raise

    def _check_site(self) -> None:
        """Refuse robots of another site: their scans would be drawn over this one's."""
        path = self.directory / "site"
        known = path.read_text("utf-8", "replace").strip() if path.exists() else ""
        if self._site is None or known == self._site:
            return
        if known:
            message = (
                f"{self.directory} holds the map of {known}, and zenoh.prefix is {self._site}: "
                "robots of two sites would be in one map. Set the prefix back, name another "
                f"directory with --data-dir, or delete {path} if it is the same site"
            )
            raise JournalError(message)
        try:
            path.write_text(self._site + "\n", "utf-8")
        except OSError as error:
            logger.warning("%s cannot be written: %s", path, error)

    def _unusable(self, error: OSError | ValueError) -> str:
        why = getattr(error, "strerror", None) or str(error)
        if isinstance(error, FileExistsError | NotADirectoryError):
            why = "there is a file, or a link to nothing, where a folder is expected"
        return (
            f"cannot use the data directory {self.directory}: {why}. It must be a folder that this "
            "user may write to, on a disk that is mounted for writing; mend that, or name another "
            "with --data-dir"
        )

    def close(self) -> None:
        """Close the journal and unlock the directory. May be called twice."""
        self.journal.close()
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def checkpoints(self) -> list[Path]:
        """All checkpoints, the newest last."""
        return sorted(self.directory.glob(_PATTERN))

    def newest(self) -> str:
        """What `load` will read, in words; that may take a while."""
        found = self.checkpoints()
        if not found:
            return "the scans of the journal"
        return f"{found[-1].name}, {found[-1].stat().st_size / 1e6:.0f} MB"

    def load(self, executor: Executor | None = None) -> tuple[Mapper, int]:
        """Load the newest checkpoint.

        Returns:
            The map, and the position in the journal up to which it goes.

        Raises:
            MapFileError: the checkpoint is damaged, or of other settings or another journal.
        """
        found = self.checkpoints()
        if not found:
            return Mapper(self._config), 0
        path = found[-1]
        try:
            saved = read_map(path, self._settings.map_bytes_max)
            self._check(saved, path)
            mapper = load(saved.image, self._config, executor)
        except GpomError as error:
            message = f"{error}. {self._advice(path)}"
            raise MapFileError(message) from error
        logger.info("loaded checkpoint=%s scans=%d", path.name, mapper.scan_count)
        return mapper, saved.position

    def save(self, image: Mapping[str, NDArray[np.generic]], position: int) -> None:
        """Save a checkpoint and delete the oldest ones; then let go of scans in all that are kept.

        Raises:
            MapFileError: it cannot be written.
        """
        saved = self._saved(image, position)
        write_map(self.directory / f"checkpoint-{position:020d}.gpom", saved, compress=False)
        found = self.checkpoints()
        for path in found[: -self._settings.checkpoints_kept]:
            path.unlink(missing_ok=True)
        kept = found[-self._settings.checkpoints_kept :]
        self.journal.release(int(kept[0].stem.rpartition("-")[2]))

    def keep_link(self, link: Link, position: int) -> None:
        """Keep what the map was calibrated to at a position, for a restart after a kill.

        It can be found again from the scans, so a disk that does not take it is no trouble here.
        """
        kept = _KeptLink(
            journal=self.journal.identity,
            position=position,
            weights=link.weights,
            map=self._config.model_dump(mode="json"),
        )
        draft = self._link_path.with_suffix(".new")
        try:
            draft.write_text(kept.model_dump_json(), "utf-8")
            draft.replace(self._link_path)
        except OSError as error:
            logger.warning("%s cannot be written: %s", self._link_path, error)

    def kept_link(self, position: int) -> Link | None:
        """The link that was kept at `position` or later; None if it is unknown or unreadable."""
        try:
            kept = _KeptLink.model_validate_json(self._link_path.read_bytes())
            link = Link(kept.weights)
            clash = self._config.clash(MapConfig(**kept.map))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            logger.warning(
                "%s is not understood, so it is calibrated anew: %s", self._link_path, error
            )
            return None
        ours = kept.journal == self.journal.identity and not clash
        return link if ours and position <= kept.position <= self.journal.position else None

    @property
    def _link_path(self) -> Path:
        return self.directory / "link.json"

    def packed(self, mapper: Mapper, position: int) -> SavedMap:
        """A map that goes up to a position in the journal, ready to be written anywhere."""
        return self._saved(dump(mapper), position)

    def _saved(self, image: Mapping[str, NDArray[np.generic]], position: int) -> SavedMap:
        unix_s = self._clock.unix_s()
        return SavedMap(image, self._config, self.journal.identity, position, unix_s)

    def _check(self, saved: SavedMap, path: Path) -> None:
        if saved.journal != self.journal.identity:
            raise MapFileError(f"{path} belongs to another journal than the one beside it")
        if saved.position > self.journal.position:
            message = (
                f"{path} goes up to scan {saved.position}, but the journal ends at "
                f"{self.journal.position}: it is an older copy"
            )
            raise MapFileError(message)
        if clash := self._config.clash(saved.config):
            theirs = ", ".join(f"map.{name}: {value}" for name, value in clash.items())
            raise MapFileError(f"{path} was made with other settings ({theirs})")

    def _advice(self, path: Path) -> str:
        others = len(self.checkpoints()) - 1
        instead = (
            f"to go on from the checkpoint before it ({others} left)"
            if others
            else "to integrate all scans of the journal anew"
        )
        return (
            "Nothing was changed. Put back what belongs there, set the settings back, or move "
            f"{path.name} away {instead}"
        )


def catch_up(mapper: Mapper, journal: Journal, position: int) -> int:
    """Integrate and train what the journal holds beyond a position; how many scans that was."""
    count = 0
    for stored in journal.replay(position, journal.position):
        with suppress(InvalidScanError):  # it had no place on the map then either
            mapper.update(wire.decode(stored.payload, max_beams=UNLIMITED_BEAMS))
        count += 1
    if count:  # else the map is as it was saved, its calibration too
        mapper.train()
    return count
