"""The frames of a fleet as one hears them, each robot's told by the namespace of its topics."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator

from gpom_core.errors import UnknownPoseError
from gpom_core.frames import FrameTree
from gpom_core.ros.messages import StampedPose, read_transforms

_STATIC = "tf_static"


class FleetFrames:
    """Learns from transforms and poses; tells where sensors are, and why not.

    What is said in a namespace holds in those below it: `/fleet/r1/front/scan` is placed by
    `/fleet/r1/tf`, completed by `/tf`.

    Args:
        map_frame: that sensors are to be placed in.
        from_tf: whether `/tf` counts; `/tf_static` always does.
    """

    def __init__(self, map_frame: str, *, from_tf: bool) -> None:
        self._map_frame = map_frame
        self._from_tf = from_tf
        self._trees: dict[str, FrameTree] = {"": FrameTree(keep_s=None)}
        self._speakers: defaultdict[tuple[str, str], set[bytes]] = defaultdict(set)

    def hear_transforms(self, topic: str, payload: bytes, gid: bytes | None) -> None:
        """Take a ``tf2_msgs/TFMessage``.

        Raises:
            RosMessageError: it cannot be read.
            InvalidTransformError: one of its transforms is none; the others are taken.
        """
        fixed = topic.endswith(_STATIC)
        if not (fixed or self._from_tf):
            return
        namespace = _namespace(topic)
        tree = self._tree(namespace)
        for item in read_transforms(payload):
            tree.add(item.parent, item.child, item.pose, None if fixed else item.stamp_ns)
            if gid is not None and not fixed:
                self._speakers[namespace, item.child].add(gid)

    def hear_pose(self, topic: str, found: StampedPose, base_frame: str) -> None:
        """Take the pose of a robot in the map."""
        tree = self._tree(_namespace(topic))
        tree.add(self._map_frame, found.child or base_frame, found.pose, found.stamp_ns)

    def place(self, topic: str, scans: Iterable[tuple[str, int]]) -> tuple[Counter[str], list[str]]:
        """Look where the scans of a topic, given as frames and stamps, were measured.

        Returns:
            How many cannot be placed, by reason, and a sentence for each frame and reason, the
            most frequent first.
        """
        tree = self._tree(_namespace(topic))
        counts: Counter[tuple[str, str]] = Counter()
        sentences: dict[tuple[str, str], str] = {}
        for frame, stamp_ns in scans:
            try:
                tree.lookup(self._map_frame, frame, stamp_ns)
            except UnknownPoseError as error:
                counts[frame, error.reason] += 1
                sentences[frame, error.reason] = str(error)
        reasons: Counter[str] = Counter()
        for (_, reason), count in counts.items():
            reasons[reason] += count
        return reasons, [sentences[key] for key, _ in counts.most_common()]

    def quarrels(self, topic: str, frame: str) -> Iterator[str]:
        """Say where nodes disagree about a frame on the way from a sensor to the map."""
        tree = self._tree(_namespace(topic))
        for child, parent, rival in tree.rivals(frame):
            yield f"{child} hangs on {parent} and on {rival} by turns: two nodes say where it is"
        parents = tree.frames()
        child = frame
        for _ in parents:
            if child not in parents:
                return
            speakers = max((len(self._speakers[key, child]) for key in _above(topic)), default=0)
            if speakers > 1:
                yield f"{speakers} nodes publish the transform from {parents[child]} to {child}"
            child = parents[child]

    def _tree(self, namespace: str) -> FrameTree:
        tree = self._trees.get(namespace)
        if tree is None:
            above = self._tree(_namespace(namespace))
            tree = self._trees[namespace] = FrameTree(above, keep_s=None)
        return tree


def _namespace(topic: str) -> str:
    return topic.rpartition("/")[0]


def _above(topic: str) -> Iterator[str]:
    """Give the namespaces of a topic, the nearest first."""
    while topic:
        topic = _namespace(topic)
        yield topic
