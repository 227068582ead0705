import io
import threading
from concurrent.futures import Future

import numpy as np
import pytest
from PIL import Image

from gpom_core import Mapper
from gpom_core.snapshot import Snapshot
from service import palettes
from service.errors import BusyError
from service.query_desk import QueryDesk
from service.tile_raster import draw, empty
from service.tile_scheme import TILE_PIXELS, TileAddress
from service.tile_store import Stamps, TileKey, TileStore
from tests.service.rooms import payload_at, scan_at


@pytest.fixture(scope="module")
def room() -> Snapshot:
    mapper = Mapper()
    for step in range(4):
        mapper.update(scan_at(0.2 * step, 0.1))
    return mapper.train()


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"))


class TestScheme:
    def test_zoom_zero_is_a_pixel_to_the_metre(self) -> None:
        assert TileAddress(0, 0, -1).bounds == (0.0, 0.0, 256.0, 256.0)

    def test_rows_count_southwards(self) -> None:
        assert TileAddress(5, -1, 0).bounds == (-8.0, -8.0, 0.0, 0.0)

    @pytest.mark.parametrize(("zoom", "x", "y"), [(0, 0, 0), (3, -2, 5), (-2, 1, -3)])
    def test_four_tiles_of_the_next_zoom_are_one(self, zoom: int, x: int, y: int) -> None:
        quarters = [TileAddress(zoom + 1, 2 * x + i, 2 * y + j) for i in (0, 1) for j in (0, 1)]
        edges = np.array([quarter.bounds for quarter in quarters])

        assert (*edges[:, :2].min(axis=0), *edges[:, 2:].max(axis=0)) == (
            TileAddress(zoom, x, y).bounds
        )

    def test_a_tile_touches_no_square_that_only_meets_its_edge(self) -> None:
        assert TileAddress(5, 0, -1).squares(8.0) == (range(1), range(1))
        assert TileAddress(6, 1, -1).squares(8.0) == (range(1), range(1))
        assert TileAddress(4, 0, 0).squares(8.0) == (range(2), range(-2, 0))


class TestPicture:
    @pytest.mark.parametrize("zoom", [4, 5, 6, 7])
    def test_pixels_are_the_map_function(self, room: Snapshot, zoom: int) -> None:
        tile = TileAddress(zoom, 0, 0)
        xmin, _, _, ymax = tile.bounds
        rows, columns = np.random.default_rng(1).integers(0, TILE_PIXELS, (2, 1000))
        x = xmin + (columns + 0.5) * tile.pixel_m
        y = ymax - (rows + 0.5) * tile.pixel_m
        exact = room.query(np.column_stack((x, y)))
        image = pixels(draw(room, tile, "occupancy", "light"))[rows, columns]
        table = palettes.table(palettes.TILES["occupancy", "light"], 64).astype(int)
        sure = image[:, 3] == 255
        shade = np.abs(table[None, :, :] - image[sure, None, :3]).sum(axis=2).argmin(axis=1)

        assert sure.any()
        assert np.quantile(np.abs(shade / 63 - exact.occupancy[sure]), 0.95) < 0.03
        assert (image[exact.variance > 0.95 * room.prior_variance, 3] == 0).all()

    def test_walls_do_not_vanish_from_afar(self, room: Snapshot) -> None:
        image = pixels(draw(room, TileAddress(0, -1, -1), "state", "light"))
        occupied = palettes.TILES["state", "light"][1]

        assert (image[-3:, -3, :3] == occupied).all(axis=-1).any()

    def test_neighbours_join_without_a_seam(self, room: Snapshot) -> None:
        left, right = (draw(room, TileAddress(8, x, 0), "variance", "dark") for x in (0, 1))
        step = pixels(left)[:, -1].astype(int) - pixels(right)[:, 0].astype(int)
        usual = np.diff(pixels(left).astype(int), axis=1)

        assert np.abs(step).max() <= np.abs(usual).max() + 8

    def test_the_unknown_is_transparent(self, room: Snapshot) -> None:
        for layer in ("occupancy", "variance", "state"):
            assert not pixels(draw(room, TileAddress(5, 40, 40), layer, "light"))[..., 3].any()
        assert not pixels(empty())[..., 3].any()

    @pytest.mark.parametrize("theme", ["light", "dark"])
    @pytest.mark.parametrize("layer", ["occupancy", "variance"])
    def test_lightness_tells_the_value(self, layer: str, theme: str) -> None:
        light = palettes.table(palettes.TILES[layer, theme], 64) @ np.array(
            [0.2126, 0.7152, 0.0722]
        )
        steps = np.diff(light)

        assert (steps > 0).all() or (steps < 0).all()


class TestStore:
    TILE = TileAddress(5, 0, 0)

    def test_a_change_elsewhere_leaves_the_stamp(self, room: Snapshot) -> None:
        stamps = Stamps(Snapshot(), {}).followed_by(room)

        assert stamps.of(self.TILE) == stamps.of(TileAddress(0, 0, 0)) == room.version
        assert stamps.of(TileAddress(5, 9, 9)) == 0

    def test_each_picture_is_drawn_once(self, room: Snapshot) -> None:
        desk = QueryDesk(1, 8, 1)
        store = TileStore(desk, 2**20)
        key = TileKey(self.TILE, "state", "light", room.version)
        futures = [store.picture(key, room) for _ in range(3)]
        (first, *_) = (f.result(30) if isinstance(f, Future) else f for f in futures)
        desk.close()

        assert store.drawn == 1
        assert store.picture(key, room) == first

    def test_memory_is_bounded(self, room: Snapshot) -> None:
        desk = QueryDesk(1, 100, 1)
        bytes_max = 10_000
        store = TileStore(desk, bytes_max)
        for stamp in range(1, 40):
            key = TileKey(TileAddress(5, 50, 0), "state", "light", stamp)
            future = store.picture(key, room)
            assert isinstance(future, Future)
            future.result(30)
        desk.close()

        assert 0 < store.bytes_used <= bytes_max

    def test_too_many_at_once_are_refused(self, room: Snapshot) -> None:
        desk = QueryDesk(1, 0, 1)
        store = TileStore(desk, 2**20)
        begun, done = threading.Event(), threading.Event()
        desk.submit(lambda: begun.set() or done.wait(30))
        begun.wait(30)

        with pytest.raises(BusyError):
            store.picture(TileKey(self.TILE, "variance", "light", 1), room)
        done.set()
        desk.close()


class TestRoute:
    def map_a_room(self, client, source) -> None:
        source.put("r", "laser", payload_at())
        assert client.post("/v1/flush", json={"timeout_s": 60}).is_success

    def test_a_tile_is_kept_until_something_under_it_changes(self, client, source) -> None:
        self.map_a_room(client, source)
        first = client.get("/v1/tiles/occupancy/5/0/0.png")
        again = client.get(
            "/v1/tiles/occupancy/5/0/0.png", headers={"If-None-Match": first.headers["etag"]}
        )
        assert (first.status_code, first.headers["content-type"]) == (200, "image/png")
        assert first.headers["cache-control"] == "no-cache"
        assert pixels(first.content).shape == (TILE_PIXELS, TILE_PIXELS, 4)
        assert (again.status_code, again.content) == (304, b"")

        source.put("r", "laser", payload_at(0.5, 0.5, seq=2))
        assert client.post("/v1/flush", json={"timeout_s": 60}).is_success
        after = client.get(
            "/v1/tiles/occupancy/5/0/0.png", headers={"If-None-Match": first.headers["etag"]}
        )
        assert after.status_code == 200
        assert after.headers["etag"] != first.headers["etag"]

    def test_a_draft_is_coarse_and_gives_way_to_the_real_one(self, client, source) -> None:
        self.map_a_room(client, source)
        path = "/v1/tiles/occupancy/5/0/0.png"
        draft = client.get(f"{path}?draft=1")
        real = client.get(path)
        again = client.get(f"{path}?draft=1")

        assert "etag" not in draft.headers
        assert draft.headers["cache-control"] == "no-store"
        assert draft.content != real.content == again.content
        assert "etag" in again.headers
        near = np.abs(pixels(draft.content).astype(int) - pixels(real.content)).mean()
        assert near < 10

    def test_an_empty_map_has_tiles(self, client) -> None:
        tile = client.get("/v1/tiles/state/-4/-3/7.png?theme=dark")

        assert not pixels(tile.content)[..., 3].any()

    @pytest.mark.parametrize(
        "path",
        ["mean/0/0/0.png", "state/11/0/0.png", "state/0/x/0.png", "state/0/9999999999/0.png"],
    )
    def test_what_cannot_be_is_refused(self, client, path: str) -> None:
        refused = client.get(f"/v1/tiles/{path}")

        assert refused.status_code == 422
        assert refused.headers["content-type"].startswith("application/problem+json")
