import pytest

from gpom_core.errors import UnknownPoseError
from gpom_core.frames import FRAMES_MAX, FrameTree
from gpom_core.transforms import IDENTITY, from_planar, planar

S = 1_000_000_000


def tree_of_a_robot(**kwargs) -> FrameTree:
    """It drives along x by 1 m/s, from 0 s to 10 s; the laser is 0.5 m before its middle."""
    tree = FrameTree(**kwargs)
    for second in range(11):
        tree.add("odom", "base", from_planar(float(second), 0.0, 0.0), second * S)
    tree.add("map", "odom", from_planar(100.0, 0.0, 0.0), None)
    tree.add("base", "laser", from_planar(0.5, 0.0, 0.0), None)
    return tree


def test_follows_the_chain_and_interpolates() -> None:
    pose = tree_of_a_robot().lookup("map", "laser", round(2.25 * S))
    assert pose.x_m == pytest.approx(102.75)


def test_finds_frames_on_other_branches_and_below() -> None:
    tree = tree_of_a_robot()
    tree.add("base", "camera", from_planar(0.0, 2.0, 0.0), None)
    assert planar(tree.lookup("camera", "laser", S))[:2] == pytest.approx((0.5, -2.0))
    assert tree.lookup("laser", "map", S).x_m == pytest.approx(-101.5)
    assert tree.lookup("laser", "laser", 0) == IDENTITY


@pytest.mark.parametrize(
    ("target", "source", "second", "reason", "words"),
    [
        ("map", "laser", 10.5, "too_new", "odom to base is known up to 0.500 s before"),
        ("map", "laser", -1, "too_old", "only from 1.000 s after"),
        ("map", "radar", 1, "unconnected", "no frame is called radar"),
        ("site", "laser", 1, "unconnected", "no frame is called site; laser hangs on map"),
    ],
)
def test_says_why_not(target, source, second, reason, words) -> None:
    with pytest.raises(UnknownPoseError, match=words) as caught:
        tree_of_a_robot().lookup(target, source, round(second * S))
    assert caught.value.reason == reason


def test_says_when_nothing_is_known_or_trees_are_apart() -> None:
    tree = FrameTree()
    with pytest.raises(UnknownPoseError, match="no transforms at all"):
        tree.lookup("map", "laser", 0)
    tree.add("map", "odom", IDENTITY, None)
    tree.add("base", "laser", IDENTITY, None)
    with pytest.raises(UnknownPoseError, match="laser hangs on base, which has no connection"):
        tree.lookup("map", "laser", 0)


def test_completes_itself_from_the_shared_tree() -> None:
    shared = FrameTree()
    shared.add("map", "odom", from_planar(1.0, 0.0, 0.0), None)
    own = FrameTree(shared)
    own.add("odom", "laser", from_planar(2.0, 0.0, 0.0), None)
    assert own.lookup("map", "laser", 0).x_m == pytest.approx(3.0)


def test_forgets_what_is_long_past() -> None:
    tree = FrameTree(keep_s=10.0)
    for index in range(2_000):
        tree.add("map", "base", IDENTITY, index * S // 10)
    with pytest.raises(UnknownPoseError, match="known only from"):
        tree.lookup("map", "base", 100 * S)
    assert tree.lookup("map", "base", 195 * S) == IDENTITY


def test_starts_anew_when_the_clock_is_set_back() -> None:
    tree = tree_of_a_robot(keep_s=5.0)
    tree.add("odom", "base", from_planar(7.0, 0.0, 0.0), -100 * S)
    tree.add("odom", "base", from_planar(8.0, 0.0, 0.0), -99 * S)
    assert tree.lookup("odom", "base", round(-99.5 * S)).x_m == pytest.approx(7.5)


def test_takes_moments_in_any_order_and_the_last_word_on_each() -> None:
    tree = FrameTree()
    for second in (3, 1, 2, 1):
        tree.add("map", "base", from_planar(float(second), 0.0, 0.0), second * S)
    tree.add("map", "base", from_planar(20.0, 0.0, 0.0), 2 * S)
    assert tree.lookup("map", "base", round(1.5 * S)).x_m == pytest.approx(10.5)


def test_a_circle_of_frames_ends() -> None:
    tree = FrameTree()
    tree.add("a", "b", IDENTITY, None)
    tree.add("b", "a", IDENTITY, None)
    with pytest.raises(UnknownPoseError):
        tree.lookup("map", "a", 0)


def test_a_new_parent_replaces_the_old_one() -> None:
    tree = tree_of_a_robot()
    tree.add("map", "base", from_planar(7.0, 0.0, 0.0), S)
    assert tree.lookup("map", "laser", S).x_m == pytest.approx(7.5)


def test_takes_so_many_frames_and_no_more() -> None:
    tree = FrameTree()
    taken = [tree.add("map", f"f{n}", IDENTITY, None) for n in range(FRAMES_MAX + 1)]
    assert sum(taken) == FRAMES_MAX
