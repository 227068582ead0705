"""Names and addresses: where scans go on zenoh, and where the map service is by default."""

from dataclasses import dataclass

from gpom_core.errors import ConfigurationError

DEFAULT_PREFIX = "gpom/v1/site"
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
DEFAULT_URL = "http://127.0.0.1:8080"

# Wildcards, separators and parameters of zenoh key expressions.
_FORBIDDEN = "/*$#?"
# `_` marks the service's own keys (`_map`), `@` chunks that wildcards do not match.
_RESERVED_STARTS = ("_", "@")


@dataclass(frozen=True, slots=True)
class StreamKeys:
    """The keys of one stream of scans.

    Attributes:
        prefix: of the site, one or more chunks.
        robot: one chunk.
        sensor: one chunk.

    Raises:
        ConfigurationError: a name cannot be part of a key.
    """

    prefix: str
    robot: str
    sensor: str

    def __post_init__(self) -> None:
        for chunk in self.prefix.split("/"):
            check_chunk(f"a part of the prefix {self.prefix!r}", chunk)
        for kind, name in (("robot", self.robot), ("sensor", self.sensor)):
            check_chunk(f"the {kind} name", name)
            if name.startswith(_RESERVED_STARTS):
                message = f"the {kind} name {name!r} begins with '_' or '@', which is reserved"
                raise ConfigurationError(message)

    @property
    def scan(self) -> str:
        """Where scans are put."""
        return f"{self.prefix}/{self.robot}/scan/{self.sensor}"

    @property
    def cursor(self) -> str:
        """Where the service answers up to which scan it has the stream."""
        return f"{self.prefix}/{self.robot}/cursor/{self.sensor}"

    @property
    def ack(self) -> str:
        """Where the service says up to which scan the stream is stored."""
        return f"{self.prefix}/{self.robot}/ack/{self.sensor}"

    @property
    def alive(self) -> str:
        """The robot's liveliness token."""
        return f"{self.prefix}/{self.robot}/alive"

    @property
    def map_alive(self) -> str:
        """The service's liveliness token."""
        return f"{self.prefix}/_map/alive"


def check_chunk(what: str, name: str) -> None:
    """Refuse a name that is not exactly one chunk of a zenoh key.

    Raises:
        ConfigurationError: the name is empty or has a forbidden character.
    """
    if not name:
        message = f"{what} is empty; expected a name such as 'robot-1'"
        raise ConfigurationError(message)
    for character in name:
        if character in _FORBIDDEN or character.isspace() or not character.isprintable():
            message = (
                f"{what} {name!r} contains {character!r}; it is one part of a zenoh key, which "
                f"has no blanks and none of {' '.join(_FORBIDDEN)}"
            )
            raise ConfigurationError(message)
