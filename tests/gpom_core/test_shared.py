"""Versions of a mapping that share what they have in common are each what a dictionary would be."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpom_core.shared import Shared

KEYS = st.integers(0, 60) | st.integers(-(2**62), 2**62)
CHANGES = st.tuples(st.dictionaries(KEYS, st.integers(), max_size=80), st.sets(KEYS, max_size=40))


@given(st.lists(CHANGES, max_size=6))
@settings(max_examples=60, deadline=None)
def test_every_version_is_the_dictionary_of_its_changes(changes) -> None:
    versions: list[tuple[Shared[int], dict[int, int]]] = [(Shared(), {})]
    for new, gone in changes:
        mapping, expected = versions[-1]
        later = {key: value for key, value in expected.items() if key not in gone} | new
        versions.append((mapping.updated(new, gone), later))
    for mapping, expected in versions:
        assert len(mapping) == len(expected)
        assert dict(mapping.items()) == expected
        assert sorted(mapping) == sorted(expected)
        assert sorted(mapping.values()) == sorted(expected.values())
        assert all(mapping[key] == mapping.get(key) == value for key, value in expected.items())


def test_who_is_not_in_it_is_not_found() -> None:
    mapping = Shared({1: "one"})
    assert mapping.get(2) is None
    assert 2 not in mapping
    with pytest.raises(KeyError):
        mapping[2]


@given(CHANGES, CHANGES)
@settings(max_examples=60, deadline=None)
def test_what_changed_between_two_versions_is_told(first, second) -> None:
    before = Shared({key: (key,) for key in range(200)} | first[0])
    now = before.updated({key: (value,) for key, value in second[0].items()}, second[1])
    expected = {key for key in {*before, *now} if before.get(key) is not now.get(key)}
    assert now.changed_since(before) == before.changed_since(now) == expected


def test_a_change_looks_at_little_of_what_is_there() -> None:
    before = Shared({key: object() for key in range(20_000)})
    now = before.updated({7: object()})
    kept = {id(leaf) for leaf in before.leaves()} & {id(leaf) for leaf in now.leaves()}
    assert len(kept) == sum(1 for _ in now.leaves()) - 1
