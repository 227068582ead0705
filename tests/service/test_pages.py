"""The page's files, and what it asks for beside tiles."""

import re
from pathlib import Path

import pytest

from tests.service.rooms import payload_at

PAGE = Path(__file__).parents[2] / "service/page"


@pytest.mark.parametrize("address", ["/", "/docs"])
def test_page_is_self_contained(client, address) -> None:
    response = client.get(address)
    assert response.headers["content-type"].startswith("text/html")
    policy = response.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy
    parts = re.findall(r"(?:src|href)=\"([^\"]+)\"", response.text)
    assert len(parts) > 4
    for part in parts:
        file = client.get("/" + part)
        assert file.is_success, part
        if not part.startswith("page/"):
            continue
        assert (
            client.get("/" + part, headers={"If-None-Match": file.headers["etag"]}).status_code
            == 304
        )
    for stranger in ("../settings.py", "__init__.py", "settings.py"):
        assert client.get("/page/" + stranger).status_code == 404


def test_colors_are_told_with_what_they_stand_for(client) -> None:
    colors = client.get("/page/palettes.json")
    assert colors.json()["dark"]["occupancy"]
    assert colors.json()["variance_max"] == 0.8  # from there on nothing is known
    again = client.get("/page/palettes.json", headers={"If-None-Match": colors.headers["etag"]})
    assert again.status_code == 304


def test_no_file_of_the_page_is_longer_than_it_can_be_read_or_asks_elsewhere() -> None:
    files = [path for path in PAGE.iterdir() if path.is_file()]
    assert len(files) > 10
    for path in files:
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert text.count("\n") < 400
        assert not re.search(r"https?://|@import|url\(", text), path


def test_experts_are_lines_that_any_map_program_draws(client, source) -> None:
    source.put("r", "laser", payload_at())
    assert client.post("/v1/flush", json={"timeout_s": 60}).is_success
    plain = client.get("/v1/experts").json()
    for answer in (
        client.get("/v1/experts", headers={"Accept": "application/geo+json"}),
        client.get("/v1/experts?format=geojson"),
    ):
        drawn = answer.json()
        assert answer.headers["content-type"] == "application/geo+json"
        assert drawn["type"] == "FeatureCollection"
        assert drawn["map_version"] == plain["map_version"]
        assert len(drawn["features"]) == len(plain["experts"]) > 0
        for feature, expert in zip(drawn["features"], plain["experts"], strict=True):
            assert feature["geometry"] == {"type": "LineString", "coordinates": expert["line"]}
            assert feature["properties"]["hits"] == expert["hits"]
