"""The running process: scans in over zenoh, one live map, answers out over HTTP and zenoh.

Rooms, from the outside in; each may use those after it, never those before:

    cli, server                the command and the life of the process
    http                       the web interface
    assembly                   connects a service as the settings say
    map_service                puts the parts together, starts and stops them
    ros                        ROS 2 robots: their scans in, the map out; a guest in zenoh_source
    zenoh_source, ingest, mapping, training, answers, events, metrics, ...   the parts
    source, journal, clock     ports to the outside world, each with an in-memory fake
    settings, errors           words everybody shares
"""
