"""ROS 2 robots over zenoh: their scans come in as scans like any other, the map goes back to them.

``gateway``
    the zenoh side of what comes in: subscriptions, a bounded queue, one thread.
``intake``
    robots and their frames: whose message it is, where its sensor was, what became of it.
``stream``
    the scans of one sensor, numbered, waiting for their transforms.
``troubles``
    what is wrong with a robot now, and since when.
``map_out``
    the map as an occupancy grid that is kept up to date.
``raster``
    cells of that grid, and which of them a change touches.
"""
