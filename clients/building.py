"""A furnished building of 30 x 20 m for simulations, with ways through it that nothing blocks.

::

    +-------+-------+------+--------+
    |  n1   .   n2  .  n3  .        |
    +--. .--+--. .--+-. .--+        |
    |        corridor      .  hall  |
    +---. .---+-----. .----+        |
    |    s1   .     s2     .        |
    +---------+------------+--------+
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

from clients.world import Box, Floats, World

WALL_M = 0.2
DOOR_M = 1.2
CLEARANCE_M = 0.75
"""Between furniture and the ways through the building."""

_WAY_STEP_M = 0.1
_ROUND_TO = 6
_UNREACHABLE = -9999  # scipy's word for "no way"


class Room(NamedTuple):
    """A rectangle between the middles of its walls, with a way around it `inset_m` from them."""

    xmin_m: float
    ymin_m: float
    xmax_m: float
    ymax_m: float
    inset_m: float = 1.6
    furniture: int = 8

    @property
    def ring(self) -> tuple[float, float, float, float]:
        """xmin, ymin, xmax, ymax of the way around the room."""
        inset = self.inset_m
        return self.xmin_m + inset, self.ymin_m + inset, self.xmax_m - inset, self.ymax_m - inset


class Door(NamedTuple):
    """An opening in a wall, between two rooms given by their places in the plan."""

    x_m: float
    y_m: float
    along_x: bool  # whether the wall runs along x
    first: int
    second: int
    width_m: float = DOOR_M


_ROOMS = (
    Room(0.0, 11.2, 7.0, 20.0),
    Room(7.0, 11.2, 14.0, 20.0),
    Room(14.0, 11.2, 21.0, 20.0),
    Room(0.0, 0.0, 10.0, 8.8),
    Room(10.0, 0.0, 21.0, 8.8),
    Room(21.0, 0.0, 30.0, 20.0, furniture=10),
    Room(0.0, 8.8, 21.0, 11.2, inset_m=0.85, furniture=0),
)
_N1, _N2, _N3, _S1, _S2, _HALL, _CORRIDOR = range(7)
_DOORS = (
    Door(3.5, 11.2, True, _N1, _CORRIDOR),
    Door(10.5, 11.2, True, _N2, _CORRIDOR),
    Door(17.5, 11.2, True, _N3, _CORRIDOR),
    Door(5.0, 8.8, True, _S1, _CORRIDOR),
    Door(15.0, 8.8, True, _S2, _CORRIDOR),
    Door(7.0, 16.0, False, _N1, _N2),
    Door(14.0, 15.0, False, _N2, _N3),
    Door(10.0, 4.4, False, _S1, _S2),
    Door(21.0, 16.0, False, _N3, _HALL),
    Door(21.0, 4.0, False, _S2, _HALL),
    Door(21.0, 10.0, False, _CORRIDOR, _HALL, width_m=1.8),
)
# Walls from x, y to x, y between the middles of their ends; doors cut themselves out.
_WALLS = (
    (0.0, 0.0, 30.0, 0.0),
    (0.0, 20.0, 30.0, 20.0),
    (0.0, 0.0, 0.0, 20.0),
    (30.0, 0.0, 30.0, 20.0),
    (0.0, 11.2, 21.0, 11.2),
    (0.0, 8.8, 21.0, 8.8),
    (21.0, 0.0, 21.0, 20.0),
    (7.0, 11.2, 7.0, 20.0),
    (14.0, 11.2, 14.0, 20.0),
    (10.0, 0.0, 10.0, 8.8),
)
_PILLARS = (
    Box(24.2, 5.0, 0.5, 0.5),
    Box(26.8, 5.0, 0.5, 0.5),
    Box(24.2, 15.0, 0.5, 0.5),
    Box(26.8, 15.0, 0.5, 0.5),
    Box(25.5, 10.0, 0.6, 0.6, pi / 4),
)


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """A world and the ways through it.

    Attributes:
        world: what is solid.
        nodes: (N, 2) places in m.
        edges: (E, 2) pairs of places with a straight, clear way between them.
        rooms: per room the places at the corners of the way around it, in order.
    """

    world: World
    nodes: Floats
    edges: NDArray[np.intp]
    rooms: tuple[tuple[int, ...], ...]

    def route(self, start: int, goal: int) -> list[int]:
        """Give the shortest way from place to place, both included."""
        lengths_m = np.linalg.norm(np.diff(self.nodes[self.edges], axis=1)[:, 0], axis=1)
        count = len(self.nodes)
        graph = coo_array((lengths_m, tuple(self.edges.T)), shape=(count, count)).tocsr()
        _, before = shortest_path(graph, directed=False, indices=start, return_predecessors=True)
        places = [goal]
        while places[-1] != start and before[places[-1]] != _UNREACHABLE:
            places.append(int(before[places[-1]]))
        return places[::-1]


def furnished_building(seed: int = 0) -> Site:
    """Build the site; the seed places the furniture."""
    rng = np.random.default_rng([seed, 0xF0])
    nodes, edges, rooms = _ways()
    sampled = _sample(nodes[edges])
    boxes = [*_walls(), *_PILLARS]
    for room in _ROOMS:
        boxes += _furnish(room, sampled, rng)
    return Site(World(boxes), nodes, edges, rooms)


def _walls() -> list[Box]:
    boxes = []
    for x0, y0, x1, y1 in _WALLS:
        along_x = y0 == y1
        gaps = [
            ((door.x_m if along_x else door.y_m), door.width_m / 2)
            for door in _DOORS
            if door.along_x == along_x and (door.y_m == y0 if along_x else door.x_m == x0)
        ]
        ends = [(x0 if along_x else y0) - WALL_M / 2, (x1 if along_x else y1) + WALL_M / 2]
        cuts = sorted([*ends, *(at - half for at, half in gaps), *(at + half for at, half in gaps)])
        for low, high in zip(cuts[::2], cuts[1::2], strict=True):
            middle, length = (low + high) / 2, high - low
            boxes.append(
                Box(middle, y0, length, WALL_M) if along_x else Box(x0, middle, WALL_M, length)
            )
    return boxes


def _ways() -> tuple[Floats, NDArray[np.intp], tuple[tuple[int, ...], ...]]:
    """Lay a ring around every room and lead every door straight to the rings of its two rooms."""
    places: dict[tuple[float, float], int] = {}

    def place(x_m: float, y_m: float) -> int:
        return places.setdefault((round(x_m, _ROUND_TO), round(y_m, _ROUND_TO)), len(places))

    edges: set[tuple[int, int]] = set()
    corners = []
    for index, room in enumerate(_ROOMS):
        xmin, ymin, xmax, ymax = room.ring
        ring = [(xmin, ymin), (xmax, ymin), (xmax, ymax), (xmin, ymax)]
        corners.append(tuple(place(*corner) for corner in ring))
        for door in _DOORS:
            if index in (door.first, door.second):
                foot = min(max(door.x_m, xmin), xmax), min(max(door.y_m, ymin), ymax)
                edges.add((place(door.x_m, door.y_m), place(*foot)))
                ring.append(foot)
        edges |= _around(ring, room, place)
    nodes = np.array(list(places), dtype=np.float64)
    return nodes, np.array(sorted(edges), dtype=np.intp), tuple(corners)


def _around(
    ring: list[tuple[float, float]], room: Room, place: Callable[[float, float], int]
) -> set[tuple[int, int]]:
    """Join the places on each side of a ring to their neighbours."""
    xmin, ymin, xmax, ymax = room.ring
    edges = set()
    for axis, value in ((0, xmin), (0, xmax), (1, ymin), (1, ymax)):
        side = sorted({spot for spot in ring if spot[axis] == value})
        edges |= {(place(*a), place(*b)) for a, b in pairwise(side)}
    return edges


def _sample(segments: Floats) -> Floats:
    steps = int(np.abs(np.diff(segments, axis=1)).max() / _WAY_STEP_M) + 1
    share = np.linspace(0.0, 1.0, steps)[None, :, None]
    return (segments[:, :1] * (1 - share) + segments[:, 1:] * share).reshape(-1, 2)


def _furnish(room: Room, ways: Floats, rng: np.random.Generator) -> Sequence[Box]:
    """Place furniture that keeps its distance from the ways; what does not fit is left out."""
    placed: list[Box] = []
    for _ in range(room.furniture * 6):
        width, depth = rng.uniform(0.5, 1.8), rng.uniform(0.4, 0.9)
        # Most pieces stand square to the walls.
        yaw = rng.choice([0.0, pi / 2]) if rng.random() < 0.7 else rng.uniform(0.0, pi)
        reach = float(np.hypot(width, depth)) / 2
        margin = WALL_M / 2 + 0.05 + (reach if yaw % (pi / 2) else depth / 2)
        x = rng.uniform(room.xmin_m + margin, room.xmax_m - margin)
        y = rng.uniform(room.ymin_m + margin, room.ymax_m - margin)
        box = Box(float(x), float(y), float(width), float(depth), float(yaw))
        piece = World([box])
        xmin, ymin, xmax, ymax = piece.bounds_m
        inside = (
            room.xmin_m < xmin and xmax < room.xmax_m and room.ymin_m < ymin and ymax < room.ymax_m
        )
        if inside and piece.distance(ways).min() >= CLEARANCE_M:
            placed.append(box)
        if len(placed) == room.furniture:
            break
    return placed
