"""A mapping whose versions share all that they have in common.

Every swap makes a new version of the map, and a copy of the table of its experts would cost what
exists. Here entries are in small dictionaries, the leaves of a tree that is sixteen wide and as
deep as it must be, found by a hash of the key (Bagwell 2001). A changed entry copies its leaf and
the few nodes above it; all else belongs to both versions.
"""

from __future__ import annotations

from collections.abc import ItemsView, Iterable, Iterator, Mapping, ValuesView
from typing import Final, TypeAlias, TypeVar

_V = TypeVar("_V")
_Node: TypeAlias = "dict[int, _V] | tuple[_Node[_V], ...]"

_BITS: Final = 4
_WIDTH: Final = 1 << _BITS
_TOP: Final = 64 - _BITS  # the hash is used from its upper end, where a product mixes best
_LEAF_MAX: Final = 32  # entries; with more a leaf becomes a node
_GOLDEN: Final = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio (Knuth, volume 3, section 6.4)
_MASK: Final = (1 << 64) - 1


class Shared(Mapping[int, _V]):
    """An immutable mapping from integers; `updated` gives the next version of it."""

    __slots__ = ("_root", "_size")

    def __init__(self, entries: Mapping[int, _V] | None = None) -> None:
        self._root: _Node[_V] = {}
        self._size = 0
        if entries:
            self._root, self._size = _changed({}, list(entries), entries, _TOP), len(entries)

    def updated(self, new: Mapping[int, _V], gone: Iterable[int] = ()) -> Shared[_V]:
        """The version with `new` entries in place of their old selves, and without `gone` ones.

        Who is in both stays. What is gone need not have been there.
        """
        lost = [key for key in set(gone) if key not in new and key in self]
        found = sum(key in self for key in new)
        later: Shared[_V] = Shared()
        later._root = _changed(self._root, [*new, *lost], new, _TOP)
        later._size = self._size + len(new) - found - len(lost)
        return later

    def changed_since(self, before: Shared[_V]) -> set[int]:
        """Keys whose entry is not the same object in both versions, or is in one alone."""
        found: set[int] = set()
        _differences(before._root, self._root, found)
        return found

    def leaves(self) -> Iterator[dict[int, _V]]:
        """The parts that versions share as a whole; not to be changed."""
        return _leaves(self._root)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, key: int) -> _V:
        node, code, shift = self._root, (key * _GOLDEN) & _MASK, _TOP
        while isinstance(node, tuple):
            node = node[(code >> shift) & (_WIDTH - 1)]
            shift -= _BITS
        return node[key]

    def __iter__(self) -> Iterator[int]:
        for leaf in self.leaves():
            yield from leaf

    def values(self) -> ValuesView[_V]:
        """As of a dictionary; does not look for each key."""
        return _Values(self)

    def items(self) -> ItemsView[int, _V]:
        """As of a dictionary; does not look for each key."""
        return _Items(self)


class _Values(ValuesView[_V]):
    _mapping: Shared[_V]

    def __iter__(self) -> Iterator[_V]:
        for leaf in self._mapping.leaves():
            yield from leaf.values()


class _Items(ItemsView[int, _V]):
    _mapping: Shared[_V]

    def __iter__(self) -> Iterator[tuple[int, _V]]:
        for leaf in self._mapping.leaves():
            yield from leaf.items()


def _leaves(node: _Node[_V]) -> Iterator[dict[int, _V]]:
    if isinstance(node, tuple):
        for child in node:
            yield from _leaves(child)
    else:
        yield node


def _parts(keys: Iterable[int], shift: int) -> dict[int, list[int]]:
    """Keys by the child that they are in."""
    parts: dict[int, list[int]] = {}
    for key in keys:
        parts.setdefault(((key * _GOLDEN) & _MASK) >> shift & (_WIDTH - 1), []).append(key)
    return parts


def _changed(node: _Node[_V], keys: list[int], new: Mapping[int, _V], shift: int) -> _Node[_V]:
    """A node with the `new` entries under `keys`, and without those that are not among them."""
    if isinstance(node, tuple):
        children = list(node)
        for child, part in _parts(keys, shift).items():
            children[child] = _changed(children[child], part, new, shift - _BITS)
        return tuple(children)
    leaf = node.copy()
    for key in keys:
        if key in new:
            leaf[key] = new[key]
        else:
            leaf.pop(key, None)
    return leaf if len(leaf) <= _LEAF_MAX or shift < 0 else _split(leaf, shift)


def _split(leaf: dict[int, _V], shift: int) -> _Node[_V]:
    children: list[_Node[_V]] = [{} for _ in range(_WIDTH)]
    for child, keys in _parts(leaf, shift).items():
        children[child] = _changed({}, keys, leaf, shift - _BITS)
    return tuple(children)


def _differences(before: _Node[_V], now: _Node[_V], found: set[int]) -> None:
    if before is now:
        return
    if isinstance(before, tuple) and isinstance(now, tuple):
        for one, other in zip(before, now, strict=True):
            _differences(one, other, found)
        return
    old = {key: value for leaf in _leaves(before) for key, value in leaf.items()}
    new = {key: value for leaf in _leaves(now) for key, value in leaf.items()}
    found.update(key for key in old.keys() | new.keys() if old.get(key) is not new.get(key))
