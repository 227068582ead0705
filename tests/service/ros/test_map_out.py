import numpy as np
import pytest
import zenoh
import zenoh.ext

from gpom_core.ros import attachment, cdr
from gpom_core.ros.keys import NO_HASH, data_key
from service.events import MapChanged
from service.ros.map_out import MapPublisher
from service.ros.raster import Patch, cells_of, patch_over
from service.ros_settings import RosSettings
from tests.gpom_core.ros.samples import STORE
from tests.service.conftest import wait_until
from tests.service.fleet_link import locator, open_session
from tests.service.rooms import payload_at

KEYS = [
    data_key(0, "map", cdr.OCCUPANCY_GRID),
    data_key(0, "map", cdr.OCCUPANCY_GRID, NO_HASH),
    "map",
]


class Viewer:
    """What RViz does: the latched grid, then its updates."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.cells = None
        self.grids = []
        self.updates = []
        self.attachments = []
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        updates = f"{key}_updates"
        if key in KEYS[:2]:
            updates = data_key(0, "map_updates", cdr.GRID_UPDATE)
        self.held = [
            zenoh.ext.declare_advanced_subscriber(session, key, self._grid, history=history),
            session.declare_subscriber(updates, self._update),
        ]

    def _grid(self, sample: zenoh.Sample) -> None:
        grid = STORE.deserialize_cdr(sample.payload.to_bytes(), cdr.OCCUPANCY_GRID)
        self.attachments.append(attachment.read(sample.attachment.to_bytes()))
        self.cells = grid.data.reshape(grid.info.height, grid.info.width).copy()
        self.grids.append(grid)

    def _update(self, sample: zenoh.Sample) -> None:
        part = cdr.decode(sample.payload.to_bytes(), cdr.GRID_UPDATE)
        rows, columns = slice(part.y, part.y + part.height), slice(part.x, part.x + part.width)
        self.cells[rows, columns] = part.data.reshape(part.height, part.width)
        self.updates.append(part)


def settings(**fields) -> RosSettings:
    quick = {"interval_s": 0.05, "full_interval_s": 60.0, "resolution_m": 0.1, **fields}
    return RosSettings(transports=("rmw_zenoh", "bridge"), map=quick)


@pytest.fixture
def published(service):
    """Publishes the map of the service; gives where to listen, and the service."""
    opened = []

    def publish(**fields):
        session = open_session(mode="peer")
        publisher = MapPublisher(settings(**fields))
        publisher.follow(lambda: service.state.snapshot, service.events)
        publisher.attach(session, service)
        opened.append((session, publisher))
        return locator(session, "peer")

    yield publish
    for session, publisher in opened:
        publisher.detach()
        session.close()


def grow(service, source, robot, *places) -> None:
    for seq, place in enumerate(places, 1):
        source.put(robot, "laser", payload_at(*place, seq=seq))
    service.flush().result(60.0)


def expected(service, viewer):
    """What the map says of the cells of the last grid."""
    info = viewer.grids[-1].info
    x, y = info.origin.position.x, info.origin.position.y
    box = (x, y, x + info.width * 0.1, y + info.height * 0.1)
    return cells_of(service.state.snapshot.grid(box, 0.1))


@pytest.mark.parametrize("key", KEYS)
def test_who_comes_late_gets_the_map_and_then_its_changes(service, source, published, key) -> None:
    grow(service, source, "r1", (-1.0, 0.0), (-1.0, 0.5))
    endpoint = published()
    with open_session(connect=endpoint) as session:
        viewer = Viewer(session, key)
        wait_until(lambda: viewer.cells is not None, 10.0)
        assert np.array_equal(viewer.cells, expected(service, viewer))
        assert (viewer.cells == -1).any()
        assert (viewer.cells == 0).any()
        assert (viewer.cells >= 95).any()
        grow(service, source, "r2", (1.0, -0.5), (1.0, 1.0))
        wait_until(lambda: np.array_equal(viewer.cells, expected(service, viewer)), 10.0)
        assert viewer.grids[0].header.frame_id == "map"
        numbers = [item.sequence for item in viewer.attachments]
        assert numbers == sorted(numbers)


def test_changes_are_sent_as_what_changed_and_now_and_then_as_a_whole(
    service, source, published
) -> None:
    endpoint = published(full_interval_s=0.3)
    with open_session(connect=endpoint) as session:
        viewer = Viewer(session, KEYS[0])
        grow(service, source, "r1", (0.0, 0.0))
        wait_until(lambda: viewer.cells is not None, 10.0)
        grow(service, source, "r2", (0.5, 0.5), (0.6, 0.5))
        wait_until(lambda: len(viewer.updates) > 0, 10.0)
        full = len(viewer.grids)
        assert viewer.updates[0].data.size < viewer.cells.size
        wait_until(lambda: len(viewer.grids) > full, 10.0)
        wait_until(lambda: np.array_equal(viewer.cells, expected(service, viewer)), 10.0)


def test_a_bridge_with_a_namespace_gets_it_under_its_own_name(service, source, published) -> None:
    grow(service, source, "r1", (-1.0, 0.0))
    endpoint = published(topics=("map", "robot1/map"))
    with open_session(connect=endpoint) as session:
        viewers = [Viewer(session, key) for key in ("map", "robot1/map")]
        wait_until(lambda: all(viewer.cells is not None for viewer in viewers), 10.0)
        assert np.array_equal(viewers[0].cells, viewers[1].cells)


@pytest.mark.parametrize("selector", ["@/*/@ros2_pub_cache/map", "@ros2_pub_cache/*/map"])
def test_older_bridges_get_what_is_latched_when_they_ask(
    service, source, published, selector
) -> None:
    grow(service, source, "r1", (-1.0, 0.0))
    endpoint = published()
    with open_session(connect=endpoint) as session:
        viewer = Viewer(session, "map")
        wait_until(lambda: viewer.cells is not None, 10.0)
        replies = session.get(
            selector, target=zenoh.QueryTarget.ALL, accept_replies=zenoh.ReplyKeyExpr.ANY
        )
        (sample,) = [reply.ok for reply in replies]
        assert str(sample.key_expr) == "map"
        grid = STORE.deserialize_cdr(sample.payload.to_bytes(), cdr.OCCUPANCY_GRID)
        assert np.array_equal(grid.data.reshape(viewer.cells.shape), viewer.cells)


def test_a_map_that_is_too_large_is_not_published(service, source, published, caplog) -> None:
    endpoint = published(cells_max=100)
    with open_session(connect=endpoint) as session:
        viewer = Viewer(session, "map")
        grow(service, source, "r1", (0.0, 0.0))
        wait_until(lambda: "is not published any more" in caplog.text, 10.0)
        assert viewer.cells is None


@pytest.mark.parametrize("first", [(0.0, 0.0), (9e6, 9e6)])
def test_a_robot_that_is_lost_does_not_end_it(service, source, published, first) -> None:
    """Whether it is lost when the map begins, or later."""
    endpoint = published()
    with open_session(connect=endpoint) as session:
        viewer = Viewer(session, KEYS[0])
        source.put("lost", "laser", payload_at(*first, room=first, seq=1))
        service.flush().result(60.0)
        wait_until(lambda: viewer.cells is not None, 10.0)
        rooms = [(8.0 * i, 8.0 * j) for i in range(12) for j in range(12)]
        for seq, room in enumerate([*rooms, (-9e6, 0.0)], 1):
            source.put("r1", "laser", payload_at(*room, room=room, seq=seq))
        service.flush().result(60.0)
        wait_until(lambda: np.array_equal(viewer.cells, expected(service, viewer)), 20.0)
        assert viewer.grids[-1].info.width < 2000


def test_nothing_is_published_when_it_is_off(service) -> None:
    with open_session(mode="peer") as session:
        for ros in (RosSettings(), RosSettings(transports=("bridge",), map={"publish": False})):
            publisher = MapPublisher(ros)
            publisher.follow(lambda: service.state.snapshot, service.events)
            publisher.attach(session, service)
            service.events.publish(MapChanged(1, None))
            publisher.detach()


def test_patches() -> None:
    patch = patch_over((-0.05, 0.0, 0.31, 0.2), 0.1)
    assert patch == Patch(-1, 0, 5, 2)
    assert patch.grown(4) == Patch(-4, 0, 8, 4)
    assert patch.joined(Patch(10, 10, 1, 1)) == Patch(-1, 0, 12, 11)
    assert patch.grown().contains(patch)
    assert not patch.contains(patch.grown())
    assert patch.within(Patch(-4, 0, 8, 4)) == (slice(0, 2), slice(3, 8))
    assert patch.bounds(0.5) == (-0.5, 0.0, 2.0, 1.0)
    assert (patch.cells, patch.clipped(patch.grown())) == (10, patch)
    assert patch.clipped(Patch(2, -3, 9, 4)) == Patch(2, 0, 2, 1)
    assert patch.clipped(Patch(4, 0, 9, 9)) is None
