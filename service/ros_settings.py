"""Settings of the link to ROS 2 robots."""

import json
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
)
from pydantic_settings import NoDecode

from gpom_core.ros.keys import TopicPattern, Transport
from gpom_core.ros.messages import frame_name


def _split(value: Any) -> Any:
    """Take ``a,b`` or a JSON list from the environment."""
    if not isinstance(value, str):
        return value
    text = value.strip()
    if text.startswith("["):
        return json.loads(text)
    return [part.strip() for part in text.split(",") if part.strip()]


def _without_slash(name: str) -> str:
    """Name a frame as ROS 2 does: without the slash that ROS 1 began with."""
    return frame_name(name.strip())


Frame = Annotated[str, AfterValidator(_without_slash), Field(min_length=1)]
Transports = Annotated[tuple[Transport, ...], NoDecode, BeforeValidator(_split)]
Topics = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RosMapSettings(_Section):
    """The map as nav_msgs/OccupancyGrid, for RViz, Nav2 and Foxglove; over the same transports."""

    publish: bool = Field(True, description="whether to publish it; changes go to …_updates")
    topics: Topics = Field(
        ("map",), description="with the namespace; a bridge with one listens to <robot>/map"
    )
    resolution_m: float = Field(0.05, gt=0.0, description="edge of a cell")
    interval_s: float = Field(1.0, gt=0.0, description="changes are published this often at most")
    full_interval_s: float = Field(
        10.0, gt=0.0, description="after changes the whole grid, for who comes late, this often"
    )
    cells_max: int = Field(16_000_000, ge=1, description="a larger map is not published")

    @field_validator("topics")
    @classmethod
    def _are_topics(cls, topics: tuple[str, ...]) -> tuple[str, ...]:
        for topic in topics:
            if "*" in TopicPattern(topic).key:
                raise ValueError("expected plain topics, without places for names")
        return tuple(topic.removeprefix("/") for topic in topics)


class RosSettings(_Section):
    """ROS 2 robots, over the session of `zenoh`: scans and transforms in, the map out."""

    transports: Transports = Field(
        (), description="how they come: rmw_zenoh, bridge (zenoh-bridge-ros2dds) or both; [] is off"
    )
    domain: int = Field(0, ge=0, le=232, description="ROS_DOMAIN_ID; rmw_zenoh only")
    scan_topics: Topics = Field(
        ("{robot}/scan", "scan"),
        description="laser scans; {robot} and {sensor} stand for one name each, * for any",
    )
    tf_topics: Topics = Field(
        ("{robot}/tf", "tf"), description="transforms; one without {robot} is of all robots"
    )
    tf_static_topics: Topics = Field(
        ("{robot}/tf_static", "tf_static"), description="fixed transforms; likewise"
    )
    pose_from: Literal["tf", "odometry", "pose"] = Field(
        "tf",
        description="where the robot is: transforms, nav_msgs/Odometry, or "
        "geometry_msgs/PoseWithCovarianceStamped; the sensor on it always by tf_static",
    )
    pose_topics: Topics = Field(
        ("{robot}/odom", "odom"), description="of poses, when they do not come from tf"
    )
    map_frame: Frame = Field("map", description="that scans are placed in, and the grid is in")
    base_frame: Frame = Field(
        "base_link", description="whose pose a message tells that names no child frame"
    )
    robot: str = Field("robot", description="name of the robot whose topics do not tell")
    wait_s: float = Field(2.0, gt=0.0, description="a scan waits so long for its transform")
    waiting_max: int = Field(
        200, ge=1, description="scans of one sensor that wait; then the oldest goes"
    )
    queue_messages_max: int = Field(
        4096, ge=1, description="received and not looked at; then block"
    )
    correct_motion: bool = Field(
        True, description="take out motion within a sweep, when the sensor tells time_increment"
    )
    no_returns: Literal["free", "ignore"] = Field(
        "free", description="what +inf says of the space along the beam, up to range_max"
    )
    range_ceiling_m: float | None = Field(
        None, gt=0.0, description="a reading this long or longer is a no-return too, as +inf"
    )
    map: RosMapSettings = RosMapSettings()

    @field_validator("scan_topics", "tf_topics", "tf_static_topics", "pose_topics")
    @classmethod
    def _are_patterns(cls, topics: tuple[str, ...]) -> tuple[str, ...]:
        for topic in topics:
            TopicPattern(topic)
        return topics
