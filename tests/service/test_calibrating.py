from concurrent.futures import BrokenExecutor

import pytest

from gpom_core.link import Link
from gpom_core.mapper import CalibrationJob, Mapper
from service.calibrating import Calibrating, CalibrationError
from tests.service.rooms import scan_at
from tests.service.test_training import PatientExecutor


class Rig:
    def __init__(self, timeout_s: float = 60.0) -> None:
        self.mapper = Mapper()
        self.pool = PatientExecutor()
        self.wakes = 0
        self.calibrating = Calibrating(self.mapper, timeout_s=timeout_s, wake=self._wake)

    def _wake(self) -> None:
        self.wakes += 1

    def drive(self, scans: int = 3) -> None:
        for step in range(scans):
            self.mapper.update(scan_at(0.2 * step, 0.1))
        self.mapper.swap([job.run() for job in self.mapper.take_jobs(1000)])

    def finish(self) -> int:
        """Run it to its end; the number of steps."""
        for steps in range(1, 100):
            self.pool.run()
            if self.calibrating.advance(self.pool):
                return steps
        pytest.fail("it does not end")


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_nothing_new_is_nothing_to_calibrate(rig) -> None:
    rig.calibrating.begin(rig.pool)
    assert rig.pool.waiting == []
    assert not rig.calibrating.active
    number = rig.calibrating.want()
    assert rig.calibrating.active
    assert not rig.calibrating.ended(number)
    rig.calibrating.begin(rig.pool)
    assert rig.calibrating.ended(number)
    assert not rig.calibrating.active


def test_the_pool_gets_one_scan_at_a_time(rig) -> None:
    rig.drive(3)
    before = rig.mapper.snapshot()
    rig.calibrating.begin(rig.pool)
    assert len(rig.pool.waiting) == 1
    rig.calibrating.begin(rig.pool)
    assert len(rig.pool.waiting) == 1, "one is under way"
    assert rig.finish() == 4
    assert rig.wakes == 4
    after = rig.mapper.snapshot()
    assert after.link == CalibrationJob(before, rig.mapper.kept_scans, rig.mapper.config).run()
    assert after.version == before.version + 1
    rig.calibrating.begin(rig.pool)
    assert not rig.calibrating.active, "nothing is new since"


def test_who_wants_one_gets_one_begun_later(rig) -> None:
    rig.drive()
    rig.calibrating.begin(rig.pool)
    rig.drive(5)
    number = rig.calibrating.want()
    rig.finish()
    assert not rig.calibrating.ended(number)
    rig.calibrating.begin(rig.pool)
    rig.finish()
    assert rig.calibrating.ended(number)


def test_a_step_that_fails_ends_it_and_leaves_probabilities_alone(rig, monkeypatch) -> None:
    def fail(self) -> None:
        yield None
        raise ArithmeticError("no")

    monkeypatch.setattr(CalibrationJob, "steps", fail)
    rig.drive()
    number = rig.calibrating.want()
    rig.calibrating.begin(rig.pool)
    rig.pool.run()
    assert not rig.calibrating.advance(rig.pool)
    (future, _, _), rig.pool.waiting = rig.pool.waiting[0], []
    future.set_exception(ArithmeticError("no"))
    with pytest.raises(CalibrationError, match="no") as caught:
        rig.calibrating.advance(rig.pool)
    assert not caught.value.pool_is_lost
    assert rig.calibrating.ended(number)
    assert not rig.calibrating.active
    assert rig.mapper.snapshot().link == Link()
    rig.calibrating.begin(rig.pool)
    assert not rig.calibrating.active, "it is not tried again at once"


def test_workers_that_died_end_it(rig) -> None:
    class Broken(PatientExecutor):
        def submit(self, function, /, *args):
            raise BrokenExecutor("died")

    rig.drive()
    number = rig.calibrating.want()
    with pytest.raises(CalibrationError, match="died") as caught:
        rig.calibrating.begin(Broken())
    assert caught.value.pool_is_lost
    assert rig.calibrating.ended(number)
    rig.drive(5)
    rig.calibrating.want()
    rig.calibrating.begin(rig.pool)
    rig.pool.run()
    with pytest.raises(CalibrationError, match="died"):
        rig.calibrating.advance(Broken())
    assert not rig.calibrating.active


def test_a_step_that_a_closed_pool_never_ran_is_given_to_the_next(rig) -> None:
    rig.drive()
    rig.calibrating.begin(rig.pool)
    (future, _, _), rig.pool.waiting = rig.pool.waiting[0], []
    assert future.cancel()
    assert not rig.calibrating.advance(rig.pool)
    assert rig.finish() == 4


def test_a_step_that_does_not_end_hangs() -> None:
    rig = Rig(timeout_s=0.0)
    rig.drive()
    rig.calibrating.begin(rig.pool)
    assert not rig.calibrating.advance(rig.pool), "no worker has begun it"
    ((_, function, args),) = rig.pool.waiting
    function(*args)
    with pytest.raises(CalibrationError, match="did not end within 0 s") as caught:
        rig.calibrating.advance(rig.pool)
    assert caught.value.pool_is_lost
    assert not rig.calibrating.active
