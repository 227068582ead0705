"""The mapper: scans in, dirty experts out to training, trained experts in, snapshots out."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from gpom_core.config import MapConfig
from gpom_core.evidence import Evidence, UpdateReport
from gpom_core.expert import Hyperparameters, TrainingError
from gpom_core.learning import LearningRule, learn
from gpom_core.link import Link
from gpom_core.member import Member, train_member
from gpom_core.observations import Observations
from gpom_core.recalibration import SCANS, CalibrationJob
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot

__all__ = ["CalibrationJob", "Mapper", "TrainedExpert", "TrainingJob", "UpdateReport"]

TrainedExpert = Member

CALIBRATE_AFTER = 4.0  # times the map was trained anew since the last calibration, which costs two
USUAL_COUNT = 5.0  # traversals of a cell, at which an expert has the configured length scale
LENGTH_SCALE_POWER = 0.2
HEADROOM = 0.85  # of the limit of observations, where an expert grows
GROWTH = 0.15  # since its last training; a new surface makes areas around it fine
LENGTH_SCALE_RANGE = (0.85, 1.6)
MOSTLY = 0.5
LINK_TOLERANCE = 0.003  # of a probability; a smaller change is not worth a new picture


@dataclass(frozen=True, slots=True, eq=False)
class TrainingJob:
    """One dirty expert's evidence, taken; `run` is pure and may run in any thread."""

    cluster_id: int
    revision: int
    observations: Observations
    hyperparameters: Hyperparameters
    line: NDArray[np.float64]
    learning: LearningRule | None = None
    learned_before: Hyperparameters | None = None

    def run(self) -> TrainedExpert:
        """Train the expert.

        Raises:
            TrainingError: the covariance is not positive definite.
        """
        chosen = self.hyperparameters
        if self.learning is not None:
            chosen = learn(
                self.observations,
                chosen,
                rule=self.learning,
                start=self.learned_before,
                clock=monotonic,
            ).hyperparameters
        return train_member(self.cluster_id, self.revision, self.observations, chosen, self.line)


def _run_or_error(job: TrainingJob) -> TrainedExpert | TrainingError:
    try:
        return job.run()
    except TrainingError as error:
        return error


def length_scale_m(often: float, far: float, config: MapConfig) -> float:
    """Length scale of an expert: the longer, the less `often` its free areas were crossed.

    Few beams have to speak for what lies between them; many show detail, but there is none where
    most of the free area, a share `far`, is in the open.
    """
    if often == 0.0:
        return config.length_scale_m
    if far > MOSTLY:
        return config.length_scale_m * LENGTH_SCALE_RANGE[1]
    factor = float((USUAL_COUNT / max(often, 1e-9)) ** LENGTH_SCALE_POWER)
    return config.length_scale_m * min(max(factor, LENGTH_SCALE_RANGE[0]), LENGTH_SCALE_RANGE[1])


def learning_rule(config: MapConfig) -> LearningRule | None:
    """How experts learn online: the length scale alone.

    A committee shares one prior, so its signal stays. Noise cannot be learned from evidence that
    never contradicts itself, as most here: it goes to zero (measured, see ARCHITECTURE).
    """
    if not config.learn_hyperparameters:
        return None
    return LearningRule(
        spread=config.learning_spread,
        evaluations=config.learning_evaluations,
        budget_s=config.learning_budget_s,
        learned=("length_scale_m",),
    )


class Mapper:
    """Grows a map from scans. One thread owns it; its snapshots may be read from any."""

    def __init__(self, config: MapConfig | None = None) -> None:
        self.config = config or MapConfig()
        self._evidence = Evidence(self.config)
        self._learning = learning_rule(self.config)
        self._training: set[int] = set()
        self._gone: set[int] = set()
        self._splits: list[tuple[int, int]] = []  # cluster, its new half; in order
        self._scans = 0
        self._kept: list[Scan] = []  # a fair draw of the scans that brought something new
        self._telling = 0  # how many did
        self._telling_then = 0  # at the last calibration
        self._calibrated = 0  # observations in the map when it was calibrated
        self._uncalibrated = 0  # observations trained since
        self._snapshot = Snapshot(
            prior_variance=self.config.signal_std**2,
            known_variance_ratio=self.config.known_variance_ratio,
        )

    @property
    def scan_count(self) -> int:
        """Scans integrated."""
        return self._scans

    @property
    def observation_count(self) -> int:
        """Rows of merged evidence."""
        return self._evidence.observation_count

    @property
    def kept_scans(self) -> tuple[Scan, ...]:
        """Those that the map is calibrated by."""
        return tuple(self._kept)

    @property
    def expert_count(self) -> int:
        """Clusters that own evidence."""
        return int(np.count_nonzero(self._evidence.clusters.rows))

    @property
    def dirty_count(self) -> int:
        """Experts whose evidence changed since it was last trained, those in training included."""
        return len(self.dirty_ids())

    def dirty_ids(self) -> frozenset[int]:
        """Clusters whose newest evidence is not in the snapshot, those in training included."""
        return frozenset(self._training.union(self._evidence.dirty().tolist()))

    def snapshot(self) -> Snapshot:
        """The latest version of the map."""
        return self._snapshot

    def update(self, scan: Scan) -> UpdateReport:
        """Integrate one scan's evidence and mark the experts that it changes as dirty.

        Raises:
            InvalidScanError: the scan cannot be placed on the map; nothing was changed.
        """
        report = self._evidence.add(scan)
        self._scans += 1
        if report.new_observations > 0:
            self._keep(scan)
        return report

    def _keep(self, scan: Scan) -> None:
        """Keep a fair draw of `SCANS` scans to calibrate by: Vitter's algorithm R (1985).

        Numbers are drawn by a hash of how many there were, so that a restart changes nothing.
        """
        self._telling += 1
        if len(self._kept) < SCANS:
            self._kept.append(scan)
            return
        place = int(np.random.default_rng(self._telling).integers(self._telling))
        if place < SCANS:
            self._kept[place] = scan

    def refresh(self) -> None:
        """Make all experts dirty that were not trained on the very last of their evidence."""
        self._evidence.refresh()

    def take_jobs(self, limit: int) -> list[TrainingJob]:
        """At most `limit` dirty experts to train, most changed first.

        They are clean from here on; give each job's result to `swap`, or the job to `fail`.
        """
        jobs: list[TrainingJob] = []
        waiting = [c for c in self._evidence.dirty().tolist() if c not in self._training]
        waiting.reverse()
        while waiting and len(jobs) < limit:
            cluster = waiting.pop()
            revision, seen = self._evidence.take(cluster)
            observations = seen.observations()
            if len(observations) == 0:
                self._gone.add(cluster)
                continue
            if len(observations) > self._size_limit(cluster, len(observations)):
                halves = self._evidence.split(cluster, by_hits=False)
                if halves:
                    self._splits.append((cluster, halves[1]))
                    waiting.extend(halves)
                    continue
            self._training.add(cluster)
            jobs.append(
                TrainingJob(
                    cluster_id=cluster,
                    revision=revision,
                    observations=observations,
                    hyperparameters=Hyperparameters(
                        length_scale_m(seen.often, seen.far, self.config), self.config.signal_std
                    ),
                    line=seen.line,
                    learning=self._learning,
                    learned_before=self._learned(cluster),
                )
            )
        return jobs

    def _size_limit(self, cluster: int, size: int) -> float:
        """Of an expert's observations; those that grow are split before.

        So there is room for the odd cell that noise finds: a robot that is parked splits none.
        """
        member = self._snapshot.members.get(cluster)
        before = 0 if member is None else len(member.expert.observations)
        grows = size > (1.0 + GROWTH) * before
        return self.config.max_observations * (HEADROOM if grows else 1.0)

    def take_splits(self) -> list[tuple[int, int]]:
        """Clusters that `take_jobs` halved since last asked, with their new halves, in order."""
        splits, self._splits = self._splits, []
        return splits

    def _learned(self, cluster: int) -> Hyperparameters | None:
        member = self._snapshot.members.get(cluster)
        return None if member is None else member.expert.hyperparameters

    def swap(self, trained: Sequence[TrainedExpert]) -> Snapshot:
        """Put trained experts into a new version of the map.

        A result older than what the map holds, or of a cluster that is gone, is discarded.
        """
        self._snapshot = self._swapped(trained)
        return self._snapshot

    def _swapped(self, trained: Sequence[TrainedExpert]) -> Snapshot:
        fresh = []
        for member in trained:
            self._training.discard(member.cluster_id)
            old = self._snapshot.members.get(member.cluster_id)
            stale = old is not None and old.revision >= member.revision
            if not stale and self._evidence.clusters.rows[member.cluster_id] > 0:
                fresh.append(member)
        gone, self._gone = self._gone, set()
        if not (fresh or gone):
            return self._snapshot
        self._uncalibrated += sum(len(member.expert.observations) for member in fresh)
        return self._snapshot.swapped(fresh, gone)

    def fail(self, job: TrainingJob) -> None:
        """A job did not end well: its expert is dirty again."""
        self._training.discard(job.cluster_id)
        self._evidence.clusters.fresh[job.cluster_id] += 1

    def set_aside(self, job: TrainingJob) -> None:
        """A job is hopeless: its expert stays as it was until its evidence changes."""
        self._training.discard(job.cluster_id)

    def train(self, executor: Executor | None = None) -> Snapshot:
        """Train all dirty experts and swap them in; the new version of the map.

        Raises:
            TrainingError: an expert could not be trained; the others are.
        """
        jobs = self.take_jobs(2**31)
        run = map if executor is None else executor.map
        try:
            outcomes = list(run(_run_or_error, jobs))
        except BaseException:  # the executor broke, or the user is impatient
            for job in jobs:
                self.fail(job)
            raise
        before = self._snapshot.version
        snapshot = self._swapped([one for one in outcomes if isinstance(one, Member)])
        errors = [outcome for outcome in outcomes if isinstance(outcome, TrainingError)]
        for job, outcome in zip(jobs, outcomes, strict=True):
            if isinstance(outcome, TrainingError):
                self.fail(job)
        try:
            if self._uncalibrated > 0:
                calibration = self._calibration_of(snapshot)
                snapshot = snapshot.with_link(calibration.run())
                snapshot = replace(snapshot, version=max(snapshot.version, before + 1))
                self._settle(calibration)
        finally:
            self._snapshot = snapshot
        if errors:
            raise errors[0]
        return self._snapshot

    def take_calibration(self, *, even_if_little_is_new: bool = False) -> CalibrationJob | None:
        """The calibration to make, if much is new since the last; else None.

        Give its result to `calibrate`, or the job to `fail_calibration`.
        """
        if self._uncalibrated == 0:
            return None
        trained = self._uncalibrated > CALIBRATE_AFTER * self._calibrated
        seen = self._telling >= 2 * self._telling_then
        due = trained or seen or even_if_little_is_new
        return self._calibration_of(self._snapshot) if due else None

    def _calibration_of(self, snapshot: Snapshot) -> CalibrationJob:
        return CalibrationJob(
            snapshot, self.kept_scans, self.config, self._uncalibrated, self._telling
        )

    def calibrate(self, job: CalibrationJob, link: Link) -> Snapshot:
        """Put a new link into a new version of the map, unless the present one is as good."""
        self._settle(job)
        if link.differs(self._snapshot.link, LINK_TOLERANCE):
            later = self._snapshot.version + 1
            self._snapshot = replace(self._snapshot.with_link(link), version=later)
        return self._snapshot

    def adopt(self, link: Link) -> None:
        """Answer by a link that was fitted to this map before; when one is due does not change."""
        if link != self._snapshot.link:
            self._snapshot = self._snapshot.with_link(link)

    def fail_calibration(self, job: CalibrationJob) -> None:
        """It did not end well: probabilities stay as they are until the next is due."""
        self._settle(job)

    def _settle(self, job: CalibrationJob) -> None:
        # Not when it is taken: after a crash in between it is due again.
        members = job.snapshot.members.values()
        self._calibrated = sum(len(member.expert.observations) for member in members)
        self._uncalibrated -= job.trained
        self._telling_then = job.telling
