"""What people see and do on the live map, in a real Chromium."""

import json
import time

import httpx
import pytest

from service.settings import AccessSettings
from tests.browser.chromium import Chromium
from tests.browser.conftest import Site

SHOWN = (
    "window.gpom && gpom.tiles.settled()"
    " && document.querySelector('#link').dataset.state === 'live'"
)
# How many pixels of all tiles show something.
INK = """(async () => {
  let ink = 0;
  for (const img of document.querySelectorAll('img.tile')) {
    const canvas = Object.assign(document.createElement('canvas'), { width: 256, height: 256 });
    const pen = canvas.getContext('2d');
    pen.drawImage(img, 0, 0);
    const { data } = pen.getImageData(0, 0, 256, 256);
    for (let i = 3; i < data.length; i += 4) ink += data[i] > 128;
  }
  return ink;
})()"""
ETAGS = """Object.fromEntries(Object.entries(gpom.tiles._tiles).map(
  ([key, { el }]) => [key, el.live.etag]))"""


def show(page: Chromium, site: Site, address: str = "") -> None:
    page.open(f"{site.url}#{address}")
    page.wait(SHOWN)


def robot(page: Chromium, name: str = "anna") -> dict[str, float]:
    return page.evaluate(f"""(() => {{
      const icon = document.querySelector('.robot[data-robot={name}]');
      const box = icon.getBoundingClientRect();
      return {{ x: box.x, y: box.y, fresh: icon.dataset.fresh,
                turn: icon.querySelector('g').getAttribute('transform') }};
    }})()""")


def test_it_shows_the_map_at_once_and_asks_nobody_else(page: Chromium, site: Site) -> None:
    show(page, site)

    assert page.evaluate(INK) > 10_000
    assert "4 scans" in page.evaluate("document.querySelector('#numbers').textContent")
    assert any("/v1/tiles/occupancy/" in address for address in page.requests)
    outside = [
        a for a in page.requests if not a.startswith((site.url, f"blob:{site.url}", "data:"))
    ]
    assert [address for address in outside if not address.startswith("about:")] == []


def test_an_empty_map_says_so_and_comes_to_life(page: Chromium) -> None:
    with Site() as site:
        show(page, site)
        page.wait("!document.querySelector('#empty').hidden")
        assert "Waiting for the first scan" in page.evaluate(
            "document.querySelector('#empty').textContent"
        )

        site.scan(0.0, 0.0, 1)
        page.wait("document.querySelector('#empty').hidden && gpom.tiles.settled()")
        page.wait(f"{INK}.then((ink) => ink > 5000)")
        page.open("about:blank?")


def test_a_robot_moves_turns_and_leaves_a_trail(page: Chromium, site: Site) -> None:
    show(page, site, "view=0,0,6")
    page.wait("document.querySelector('.robot')")
    before = robot(page)
    pose = site.service.fleet.robots()[0].pose
    assert pose is not None

    for seq in range(5, 9):
        site.scan(0.2 * seq, 0.1 + 0.2 * (seq - 4), seq)
        time.sleep(0.2)
    page.wait(f"gpom.robots.pose('anna')[0] > {pose.x_m + 0.5}")
    time.sleep(0.3)  # it glides
    after = robot(page)

    assert after["x"] - before["x"] == pytest.approx(0.8 * 64, abs=2.0)
    assert before["y"] - after["y"] == pytest.approx(0.8 * 64, abs=2.0)
    assert after["fresh"] == "live"
    page.wait("document.querySelector('.robot').dataset.fresh === 'gone'")
    assert "s ago" in page.evaluate("document.querySelector('#robots').textContent")


def test_hovering_reads_what_the_api_says(page: Chromium, site: Site) -> None:
    show(page, site, "view=2.5,0.4,6")
    for x, y in ((640, 300), (700, 420), (610, 400), (30, 790)):
        page.move(x, y)
        page.wait(
            f"(() => {{ const at = gpom.map.containerPointToLatLng([{x}, {y}]);"
            "const read = document.querySelector('#value').dataset;"
            "return Math.abs(read.x - at.lng) < 1e-9 && Math.abs(read.y - at.lat) < 1e-9; })()"
        )
        read = page.evaluate("({ ...document.querySelector('#value').dataset })")
        told = site.ask(float(read["x"]), float(read["y"]))

        assert float(read["p"]) == told["occupancy"][0]
        assert float(read["variance"]) == told["variance"][0]
        words = page.evaluate("document.querySelector('#value').textContent")
        assert f"p {told['occupancy'][0]:.3f}" in words
        assert ("unknown" in words) == (not told["known"][0])


def test_only_what_changed_is_drawn_again(
    page: Chromium, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gpom_core.mapper.LINK_TOLERANCE", 1.0)  # a calibration changes every tile
    for step in range(3):
        site.scan(40.0 + 0.2 * step, 0.0, step + 1, robot="berta", room=(40.0, 0.0))
    site.flush()
    show(page, site, "view=20,0,4")
    before = page.evaluate(ETAGS)
    drawn = site.service.tiles.drawn

    site.scan(40.0, 1.5, 4, robot="berta", room=(40.0, 0.0))
    site.flush()
    version = site.service.state.snapshot.version
    page.wait(f"Object.values({ETAGS}).some((tag) => tag.endsWith('.{version}\"')) && {SHOWN}")
    after = page.evaluate(ETAGS)
    changed = {key for key, tag in after.items() if tag != before[key]}

    assert changed
    assert all(int(key.split(":")[0]) >= 1 for key in changed), changed  # the far room's
    assert any(tag == before[key] and not tag.endswith('.0"') for key, tag in after.items())
    assert site.service.tiles.drawn - drawn <= 3 * len(changed)


def test_a_lost_connection_shows_and_recovers(page: Chromium, site: Site) -> None:
    show(page, site)
    assert page.evaluate("document.querySelector('#link').textContent") == "live"

    site.stop()
    page.wait("document.querySelector('#link').dataset.state === 'lost'")
    assert page.evaluate(INK) > 10_000  # what was seen stays
    page.key("f")
    page.key("2")  # tiles that cannot come now, and are asked for again
    page.wait("Object.values(gpom.tiles._tiles).every(({ el }) => el.live.tries > 0)")

    site.start()
    site.scan(0.0, 0.0, 1)
    page.wait(SHOWN)
    site.flush()
    page.wait("document.querySelector('#numbers').textContent.includes('· 1 scan ·')")
    assert all("ERR_" in problem for problem in page.problems), page.problems
    page.problems.clear()


def test_what_keeps_the_service_from_its_work_is_said(page: Chromium, site: Site) -> None:
    show(page, site)
    assert page.evaluate("document.querySelector('#trouble').hidden")

    site.source.close()
    page.wait("/source is closed/.test(document.querySelector('#trouble').textContent)")
    site.source.open(site.service)
    page.wait("document.querySelector('#trouble').hidden")


def test_without_a_token_it_says_what_is_missing(browser: Chromium) -> None:
    with Site(access=AccessSettings(read_tokens=["t" * 32])) as site:
        browser.open(site.url)
        browser.wait("document.querySelector('#link').dataset.state === 'refused'")
        assert "Authorization" in browser.evaluate("document.querySelector('#trouble').textContent")
        browser.open("about:blank?")


def test_another_map_behind_the_same_address_is_drawn_anew(page: Chromium, site: Site) -> None:
    show(page, site, "view=0,0,6")
    assert page.evaluate(INK) > 10_000

    site.stop()
    page.wait("document.querySelector('#link').dataset.state === 'lost'")
    site.start()
    page.wait(f"{SHOWN} && {INK}.then((ink) => ink === 0)")
    assert all("ERR_" in problem for problem in page.problems), page.problems
    page.problems.clear()


def test_the_api_can_be_read_and_tried(page: Chromium, site: Site) -> None:
    page.open(f"{site.url}docs")
    page.wait("document.querySelectorAll('.opblock').length > 8")
    page.evaluate("document.querySelector('[id$=v1_status_get] button').click()")
    page.wait("document.querySelector('[id$=v1_status_get] .execute')")
    page.evaluate("document.querySelector('[id$=v1_status_get] .execute').click()")
    page.wait("/map_version/.test(document.querySelector('.live-responses-table')?.textContent)")
    assert all(a.startswith((site.url, "data:", "about:")) for a in page.requests), page.requests


def test_an_address_leads_back_to_what_was_seen(page: Chromium, site: Site) -> None:
    show(
        page, site, "view=1.5,0.25,6&layer=variance&theme=light&pin=2,1&line=-1,0,4,0&show=clusters"
    )
    page.wait("document.querySelector('.leaflet-tooltip')?.textContent.includes('variance')")
    page.wait("document.querySelector('#plot path.line')?.getAttribute('d').length > 1000")
    page.wait("location.hash.includes('pin=2,1')")

    words = dict(word.split("=") for word in page.evaluate("location.hash.slice(1)").split("&"))
    assert words == {
        "view": "1.5,0.25,6", "layer": "variance", "theme": "light", "pin": "2,1",
        "line": "-1,0,4,0", "show": "clusters",
    }  # fmt: skip
    assert page.evaluate("document.documentElement.dataset.theme") == "light"
    assert (
        page.evaluate("document.querySelector('[aria-checked=true]').dataset.layer") == "variance"
    )
    told = site.ask(2.0, 1.0)
    assert f"p {told['occupancy'][0]:.3f}" in page.evaluate(
        "document.querySelector('.leaflet-tooltip').textContent"
    )


def test_an_address_that_is_pasted_over_the_present_one_is_gone_to(
    page: Chromium, site: Site
) -> None:
    show(page, site, "view=0,0,6")
    page.evaluate("location.hash = 'view=1.5,0.25,5&layer=variance'")

    page.wait("window.gpom?.state.layer === 'variance' && gpom.map.getZoom() === 5")
    page.wait("Math.abs(gpom.map.getCenter().lng - 1.5) < 0.01")


def test_a_place_that_no_site_reaches_is_left_out_of_an_address(page: Chromium, site: Site) -> None:
    show(page, site, "view=1e308,0,3&pin=1e300,2")

    page.wait("Math.abs(gpom.map.getCenter().lng) < 100")
    assert not page.evaluate("document.querySelector('.pin')")


def test_a_drawn_line_reads_occupancy_along_it(page: Chromium, site: Site) -> None:
    show(page, site, "view=0,0,6")
    page.key("l")
    page.wait("document.querySelector('[data-act=line]').ariaPressed === 'true'")
    page.click(500, 400)
    page.click(900, 400)
    page.wait("document.querySelector('#plot path.line')")
    page.key("t")  # paints all buttons anew
    page.wait("document.documentElement.dataset.theme === 'light'")
    assert page.evaluate("document.querySelector('[data-act=line]').ariaPressed") == "true"

    ends = json.loads("[" + page.wait("location.hash.match(/line=([^&]+)/)?.[1]") + "]")
    assert ends == [-1.563, 0.0, 4.688, 0.0]
    page.key("Escape")
    assert page.evaluate("document.querySelector('#profile').hidden")


def test_every_tool_has_a_key(page: Chromium, site: Site) -> None:
    show(page, site)
    for key, layer in (("2", "variance"), ("3", "state"), ("1", "occupancy")):
        page.key(key)
        page.wait(f"document.querySelector('[data-layer={layer}]').ariaChecked === 'true'")
        page.wait(SHOWN)
    assert {"variance", "state"} <= {a.split("/tiles/")[-1].split("/")[0] for a in page.requests}
    for key, tool in (("g", "grid"), ("c", "clusters"), ("r", "robots")):
        was = page.evaluate(f"document.querySelector('[data-act={tool}]').ariaPressed")
        page.key(key)
        page.wait(f"document.querySelector('[data-act={tool}]').ariaPressed !== '{was}'")
    page.key("t")
    page.wait("document.documentElement.dataset.theme === 'light'")
    page.key("p")
    page.wait("document.querySelector('.pin')")
    page.key("n")
    page.wait("gpom.state.follow === 'anna'")
    page.key("h")
    page.wait(
        "document.querySelector('#tools').getBoundingClientRect().width === 0"
        " && location.hash.includes('bare=1')"
    )
    page.key("h")
    page.wait("document.querySelector('#tools').getBoundingClientRect().width > 0")
    page.evaluate("document.activeElement.blur()")
    page.key("ArrowRight")
    page.wait("gpom.map.getCenter().lng > 0.5")
    page.key("?")
    page.wait(
        "document.querySelector('#help').open && document.querySelectorAll('#keys dt').length > 8"
    )


def test_following_keeps_the_robot_in_the_middle(page: Chromium, site: Site) -> None:
    show(page, site, "view=0,0,6&follow=anna")
    site.scan(-1.0, -1.5, 9)

    page.wait("Math.hypot(gpom.map.getCenter().lng + 1, gpom.map.getCenter().lat + 1.5) < 0.02")


def test_a_phone_has_all_of_it(page: Chromium, site: Site) -> None:
    page.size(390, 844, scale=2.0, phone=True)
    show(page, site)

    assert page.evaluate("document.documentElement.scrollWidth") == 390
    small = page.evaluate(
        "[...document.querySelectorAll('#tools button')].filter((b) => b.offsetParent)"
        ".filter((b) => b.offsetHeight < 42).map((b) => b.textContent)"
    )
    assert small == []
    assert any("/occupancy/" in a for a in page.requests)
    page.tap(180, 420)
    page.wait("document.querySelector('.pin')")
    page.wait("document.querySelector('#value').textContent.includes('variance')")
    page.evaluate("document.querySelector('#more').click()")
    assert page.evaluate("document.querySelector('[data-act=clusters]').offsetHeight") >= 42
    page.evaluate("document.querySelector('#menu [data-act=line]').click()")
    assert not page.evaluate("document.querySelector('#menu').classList.contains('open')")


def test_scans_get_into_the_map_while_a_screen_of_tiles_is_drawn(site: Site) -> None:
    addresses = [
        f"{site.url}v1/tiles/occupancy/6/{x}/{y}.png" for x in range(-5, 5) for y in range(-3, 3)
    ]
    with httpx.Client(timeout=60) as client:
        site.scan(1.0, 1.0, 20)
        tiles = [client.get(address) for address in addresses]
        site.scan(1.0, 1.2, 21)
        site.flush()

    assert all(tile.is_success for tile in tiles)
    assert site.service.state.scans_integrated == 6
