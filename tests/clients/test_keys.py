"""Robot and sensor names are single chunks of a zenoh key."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from clients.keys import DEFAULT_PREFIX, StreamKeys
from gpom_core.errors import ConfigurationError


def test_keys_are_those_of_the_contract():
    keys = StreamKeys(DEFAULT_PREFIX, "r1", "front")
    assert keys.scan == "gpom/v1/site/r1/scan/front"
    assert keys.cursor == "gpom/v1/site/r1/cursor/front"
    assert keys.alive == "gpom/v1/site/r1/alive"
    assert keys.map_alive == "gpom/v1/site/_map/alive"


@pytest.mark.parametrize(
    "name", ["", "a/b", "*", "a*", "$", "a#", "a?b", "_map", "@x", "a b", "tab\t", "\x00", "\n"]
)
@pytest.mark.parametrize("field", ["robot", "sensor"])
def test_refuses_names_that_are_no_chunk(field, name):
    names = {"robot": "r1", "sensor": "front"} | {field: name}
    with pytest.raises(ConfigurationError, match=field):
        StreamKeys(DEFAULT_PREFIX, **names)


@pytest.mark.parametrize("prefix", ["", "/a", "a/", "a//b", "a/*/b", "a?b"])
def test_refuses_prefixes_that_are_no_key(prefix):
    with pytest.raises(ConfigurationError, match="prefix"):
        StreamKeys(prefix, "r1", "front")


@given(st.text(min_size=1))
def test_whatever_is_accepted_is_one_chunk_for_zenoh(name):
    try:
        keys = StreamKeys("site", name, "front")
    except ConfigurationError:
        return
    assert zenoh.KeyExpr("site/*/scan/*").includes(zenoh.KeyExpr(keys.scan))
