"""What ROS 2 says on the wire, as bytes in and numbers out: no ROS, no network, no files.

``cdr``
    bytes to messages and back, hostile bytes refused.
``attachment``
    what rmw_zenoh writes beside a message: its number, time and publisher.
``keys``
    zenoh keys of topics, as rmw_zenoh and zenoh-bridge-ros2dds name them.
``messages``
    laser scans, transforms and poses out of messages; occupancy grids into them.
"""
