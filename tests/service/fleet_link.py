"""The other end of zenoh: what a robot, or somebody with questions, has."""

import json

import zenoh


def open_session(
    *, connect: str | None = None, mode: str = "client", gossip: bool = False
) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in {
        "mode": mode,
        "listen/endpoints": [] if mode == "client" else ["tcp/127.0.0.1:0"],
        "connect/endpoints": [connect] if connect else [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": gossip,
        "routing/router/peers_failover_brokering": False,
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": True,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def locator(session: zenoh.Session, mode: str) -> str:
    """Where a session listens, whatever port it was given."""
    (reply,) = session.get(f"@/{session.zid()}/{mode}")
    return json.loads(reply.ok.payload.to_bytes())["locators"][0]
