import pytest
import zenoh

from gpom_core.errors import ConfigurationError
from gpom_core.ros import cdr
from gpom_core.ros.keys import (
    NO_HASH,
    TopicPattern,
    data_key,
    data_selector,
    node_token,
    presence_selectors,
    publisher_token,
    topic_of,
    topic_of_presence,
)
from tests.gpom_core.ros.vectors import (
    KEY,
    KEY_BRIDGE,
    KEY_HUMBLE,
    PRESENCE,
    PRESENCE_BRIDGE,
    PRESENCE_BRIDGE_0,
    PRESENCE_ROLLING,
)


def matches(selector: str, key: str) -> bool:
    return zenoh.KeyExpr(selector).intersects(zenoh.KeyExpr(key))


@pytest.mark.parametrize(
    ("transport", "key"), [("rmw_zenoh", KEY), ("rmw_zenoh", KEY_HUMBLE), ("bridge", KEY_BRIDGE)]
)
def test_real_keys_are_heard_and_read(transport, key) -> None:
    selector = data_selector(transport, 0, TopicPattern("{robot}/scan").key, cdr.LASER_SCAN)
    assert matches(selector, key)
    assert topic_of(transport, key) == "robot3/scan"
    other = data_selector(transport, 0, TopicPattern("{robot}/tf").key, cdr.TF_MESSAGE)
    assert not matches(other, key)


def test_domains_are_kept_apart() -> None:
    assert not matches(data_selector("rmw_zenoh", 1, "*/scan", cdr.LASER_SCAN), KEY)


@pytest.mark.parametrize(
    ("transport", "token"),
    [
        ("rmw_zenoh", PRESENCE),
        ("rmw_zenoh", PRESENCE_ROLLING),
        ("bridge", PRESENCE_BRIDGE),
        ("bridge", PRESENCE_BRIDGE_0),
    ],
)
def test_real_tokens_are_heard_once_and_read(transport, token) -> None:
    heard = presence_selectors(transport, 0, cdr.LASER_SCAN)
    assert sum(matches(selector, token) for selector in heard) == 1
    assert not any(matches(key, token) for key in presence_selectors(transport, 0, cdr.TF_MESSAGE))
    assert topic_of_presence(transport, token) == "robot3/scan"


def test_what_we_publish_is_what_ros_subscribes_to() -> None:
    assert data_key(0, "robot3/scan", cdr.LASER_SCAN) == KEY
    assert data_key(0, "robot3/scan", cdr.LASER_SCAN, NO_HASH) == KEY_HUMBLE
    token = publisher_token(
        0, "abc", "gpom", number=1, topic="map", type_name=cdr.OCCUPANCY_GRID, latched=True
    )
    assert token.split("/")[:10] == [
        "@ros2_lv",
        "0",
        "abc",
        "0",
        "1",
        "MP",
        "%",
        "%",
        "gpom",
        "%map",
    ]
    assert token.endswith("/:1:,1:,:,:,,")
    assert node_token(0, "abc", "gpom") == "@ros2_lv/0/abc/0/0/NN/%/%/gpom"


@pytest.mark.parametrize(
    ("pattern", "topic", "expected"),
    [
        ("{robot}/scan", "r1/scan", ("r1", None)),
        ("/{robot}/scan", "/r1/scan", ("r1", None)),
        ("{robot}/{sensor}/scan", "r1/front/scan", ("r1", "front")),
        ("fleet/*/{robot}/scan", "fleet/hall/r1/scan", ("r1", None)),
        ("scan", "scan", (None, None)),
        ("{robot}/scan", "a/b/scan", None),
        ("{robot}/scan", "r1/scan2", None),
        ("{robot}/scan", "*/scan", None),
        ("{robot}/{sensor}/scan", "r1/f$*/scan", None),
    ],
)
def test_patterns_tell_whose_topic_it_is(pattern, topic, expected) -> None:
    assert TopicPattern(pattern).match(topic) == expected


@pytest.mark.parametrize("text", ["", "a//b", "{robot}/{robot}", "{bot}/scan", "a/**", "a b", "a/"])
def test_refuses_what_is_no_pattern(text) -> None:
    with pytest.raises(ConfigurationError):
        TopicPattern(text)
