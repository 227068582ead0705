"""Settings of the running process. Units are in the names; unknown keys are refused.

`service.settings_file` reads them from a file, the environment and flags, and prints them.
"""

import json
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
    SecretStr,
    field_validator,
)
from pydantic_settings import NoDecode

from gpom_core.config import MapConfig
from service.ros_settings import RosSettings

QueuePolicy = Literal["block", "drop_oldest", "drop_newest"]


def _spare_cores() -> int:
    """One core is left for scans and answers."""
    return max(1, (os.cpu_count() or 1) - 1)


def _split(value: Any) -> Any:
    """Take ``a,b`` or a JSON list from the environment."""
    if not isinstance(value, str):
        return value
    text = value.strip()
    if text.startswith("["):
        return json.loads(text)
    return [part.strip() for part in text.split(",") if part.strip()]


Endpoints = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split)]


Tokens = Annotated[tuple[SecretStr, ...], NoDecode, BeforeValidator(_split)]
TOKEN_LENGTH_MIN = 16


_LONGEST_S = 1e7  # four months; no lock of the operating system waits for 1e10
_THREADS_MAX = 1024


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class HttpSettings(_Section):
    """The web interface."""

    host: str = Field("127.0.0.1", description="address to listen on; 0.0.0.0 is every network")
    port: int = Field(8080, ge=0, le=65_535, description="0 picks a free one")
    tls_certificate: Path | None = Field(None, description="PEM file; with it HTTP is HTTPS")
    tls_key: Path | None = Field(None, description="PEM file with the key of the certificate")
    query_points_max: int = Field(1_000_000, ge=1, description="points of one query")
    grid_cells_max: int = Field(4_000_000, ge=1, description="cells of one raster")
    body_bytes_max: int = Field(64 * 2**20, ge=1024, description="bytes of one request body")
    body_timeout_s: float = Field(
        30.0,
        gt=0.0,
        le=_LONGEST_S,
        description="a body of which nothing comes for so long, or after so long less than "
        "1000 bytes/s, is refused: 408",
    )
    head_timeout_s: float = Field(
        30.0,
        gt=0.0,
        le=_LONGEST_S,
        description="a connection on which the head of a request is not whole after so long is "
        "closed",
    )
    query_threads: int = Field(
        2, ge=1, le=_THREADS_MAX, description="heavy queries answered at once"
    )
    queries_waiting_max: int = Field(32, ge=0, description="heavy queries in line; then 503")
    tile_threads: int = Field(1, ge=1, le=_THREADS_MAX, description="map tiles drawn at once")
    tiles_waiting_max: int = Field(256, ge=0, description="map tiles in line; then 503")
    tile_cache_bytes_max: int = Field(
        64 * 2**20, ge=2**20, description="memory for map tiles that were drawn"
    )
    grid_cache_bytes_max: int = Field(
        32 * 2**20, ge=0, description="memory for rasters that may be asked for again"
    )
    retry_after_s: int = Field(1, ge=1, description="what a 503 or 429 tells the client to wait")
    client_requests_max: int = Field(
        32, ge=1, description="requests of one address answered at once, flushes too; then 429"
    )
    flush_timeout_max_s: float = Field(
        600.0, gt=0.0, le=_LONGEST_S, description="longest wait of one flush"
    )
    event_clients_max: int = Field(64, ge=1, description="open event streams; then 503")
    client_streams_max: int = Field(
        32, ge=1, description="open event streams of one address; then 429"
    )
    event_keepalive_s: float = Field(
        2.0, gt=0.0, le=_LONGEST_S, description="a silent stream says so this often"
    )


class AccessSettings(_Section):
    """Who may use the HTTP interface. Without tokens: everybody who can reach it."""

    read_tokens: Tokens = Field((), description="bearer tokens that may ask")
    write_tokens: Tokens = Field((), description="those that may also flush")
    admin_tokens: Tokens = Field((), description="those that may do everything")
    insecure: bool = Field(
        False, description="allow addresses that others can reach without any credentials"
    )

    @property
    def has_tokens(self) -> bool:
        """Whether anybody needs a token."""
        return bool(self.read_tokens or self.write_tokens or self.admin_tokens)

    @field_validator("read_tokens", "write_tokens", "admin_tokens")
    @classmethod
    def _are_long(cls, tokens: tuple[SecretStr, ...]) -> tuple[SecretStr, ...]:
        if any(len(token.get_secret_value()) < TOKEN_LENGTH_MIN for token in tokens):
            raise ValueError(f"expected tokens of at least {TOKEN_LENGTH_MIN} characters")
        return tokens


class ZenohSettings(_Section):
    """The session by which scans and queries of robots arrive."""

    prefix: str = Field("gpom/v1/site", description="key prefix of the site")
    listen: Endpoints = Field(
        ("tcp/127.0.0.1:7447",), description="endpoints to listen on; [] for none"
    )
    connect: Endpoints = Field((), description="routers or peers to connect to")
    queries_max: int = Field(
        16, ge=1, description="queries over zenoh open at once, of all who ask; then 429"
    )
    robots: Endpoints = Field(
        (),
        description="names of robots; if given, each may publish under its own name only, and "
        "says who it is by user name or certificate",
    )
    passwords_file: Path | None = Field(
        None, description="lines user:password, one for each robot that may connect"
    )
    user: str | None = Field(None, description="by which the service is known to a router")
    password: SecretStr | None = Field(None, description="of that user")
    options: dict[str, JsonValue] = Field(
        {}, description="further zenoh configuration, path: value, such as transport/link/tls/…"
    )

    @field_validator("robots")
    @classmethod
    def _are_names(cls, robots: tuple[str, ...]) -> tuple[str, ...]:
        # As parts of rules: "*" would be allowed to speak for everybody.
        if any(not name or set(name) & set("/*$#?") for name in robots):
            raise ValueError("expected names of robots, without / * $ # ?")
        return robots

    @field_validator("prefix")
    @classmethod
    def _is_plain_key(cls, prefix: str) -> str:
        chunks = prefix.split("/")
        if not all(chunks) or any(set(chunk) & set("*$#?") for chunk in chunks):
            raise ValueError("expected chunks joined by single slashes, without * $ # ?")
        return prefix


class IngestSettings(_Section):
    """What is taken in, and what happens when more arrives than can be handled."""

    policy: QueuePolicy = Field(
        "block",
        description="when the queue is full: block (robots are slowed down), drop_oldest or "
        "drop_newest (counted)",
    )
    queue_scans_max: int = Field(4096, ge=1, description="received, not yet decoded")
    queue_bytes_max: int = Field(128 * 2**20, ge=1024, description="of the same")
    batch_scans_max: int = Field(256, ge=1, description="stored in one commit")
    backlog_scans_max: int = Field(1024, ge=1, description="stored, not yet in the map")
    beams_max: int = Field(
        65_536, ge=1, description="a scan with more is stored, but stays out of the map"
    )
    robots_max: int = Field(1000, ge=1, description="scans of further robots are refused")


class JournalSettings(_Section):
    """What is kept in data_dir, so that a restart loses nothing. Unused without data_dir."""

    size_bytes_max: int = Field(
        16 * 2**30, ge=2**20, description="of stored scans; what then happens is `retention`"
    )
    retention: Literal["drop_oldest", "keep"] = Field(
        "drop_oldest",
        description="at the size limit: delete the oldest scans that are in a checkpoint of the "
        "map, or keep all and take no more scans",
    )
    checkpoint_interval_s: float = Field(
        60.0,
        gt=0.0,
        le=_LONGEST_S,
        description="the map is saved this often; scans since are integrated again",
    )
    checkpoints_kept: int = Field(2, ge=1, le=100, description="the newest of them")
    map_bytes_max: int = Field(
        4 * 2**30, ge=2**20, description="unpacked size of a checkpoint or an imported map"
    )


class TrainingSettings(_Section):
    """How experts are kept up to date."""

    workers: int = Field(
        default_factory=_spare_cores,
        ge=1,
        le=_THREADS_MAX,
        description="threads; default: all cores but one",
    )
    swap_interval_s: float = Field(
        0.1, gt=0.0, le=10.0, description="under load, answers see new experts this often"
    )
    attempts_max: int = Field(3, ge=1, description="a failing expert is set aside after these")
    job_timeout_s: float = Field(
        60.0,
        gt=0.0,
        le=_LONGEST_S,
        description="training one expert that takes longer hangs, and has failed",
    )


class Settings(_Section):
    """Everything that can be set."""

    data_dir: Path | None = Field(
        None, description="where the map is kept over restarts; null: in memory only"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info")
    http: HttpSettings = HttpSettings()
    access: AccessSettings = AccessSettings()
    zenoh: ZenohSettings = ZenohSettings()
    ros: RosSettings = RosSettings()
    ingest: IngestSettings = IngestSettings()
    journal: JournalSettings = JournalSettings()
    training: TrainingSettings = TrainingSettings()
    map: MapConfig = MapConfig()

    @field_validator("data_dir", mode="before")
    @classmethod
    def _is_named(cls, folder: Any) -> Any:
        if folder == "":  # it would be where the process was started
            raise ValueError("expected a folder; null, or nothing at all, keeps the map in memory")
        return folder
