"""What robots and users of the map import, and the command `gpom`.

Rooms, from the ground up; each may use those above it in this list and gpom_core:

1. errors: the client's branch of the tree of errors.
2. keys, logs, world: names on zenoh; what a log reader offers; geometry of simulated sites.
3. carmen, building, sensor, calls: one log format; a furnished building; a range sensor; HTTP.
4. link, motion, map_client: a zenoh session; paths of robots; the map's HTTP client.
5. publisher, simulate: numbered scans of one robot; robots that drive and scan.
6. dispatch, replay: scans sent on time; a log as several robots.
7. *_command, cli: the command line.
"""
