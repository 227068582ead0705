"""The part of the zenoh router, played by a Python session where its image cannot be had."""

import signal
import sys
import threading

import zenoh

if sys.argv[1] == "--config":
    config = zenoh.Config.from_file(sys.argv[2])
else:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", '["tcp/0.0.0.0:7447"]')
    config.insert_json5("scouting/multicast/enabled", "false")
stop = threading.Event()
for number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(number, lambda *_: stop.set())
with zenoh.open(config):
    stop.wait()
