"""Bytes as other programs write them, so that a change of ours cannot change what is expected.

Recorded from zenoh-ros2-sdk 0.1.8, a client for rmw_zenoh: PLAIN, SCAN_LITTLE, KEY, PRESENCE.
PRESENCE_BRIDGE has the form of a token in a published log of zenoh-bridge-ros2dds 1.0.0:
``@/ccadec0e53bdfe8e9e3ea052ab68394e/@ros2_lv/MP/rosout/rcl_interfaces§msg§Log/:1:1:0,1000``.
Made by hand after the sources of rmw_zenoh and zenoh-bridge-ros2dds: the others.
"""

GID = bytes.fromhex("e65d2e14 538c4ff8 90faa17a 6f69d43d")
SEQUENCE = 3
SOURCE_NS = 1_795_357_666_574_382_592

PLAIN = bytes.fromhex("0300000000000000 00b6f0184964ea18 10") + GID
# As rmw_zenoh wrote it until the spring of 2025 (Humble 0.1.1, Jazzy 0.2.3, Rolling 0.5.0).
LABELLED = (
    bytes.fromhex("0f 73657175656e63655f6e756d626572 0300000000000000")
    + bytes.fromhex("10 736f757263655f74696d657374616d70 00b6f0184964ea18")
    + bytes.fromhex("0a 736f757263655f676964 10")
    + GID
)

# Frame laser, stamp 1.000000002 s, ranges 0 to 4, increment 0.1, limits 0.1 to 10.
SCAN_LITTLE = bytes.fromhex(
    "00010000 01000000 02000000 06000000 6c61736572000000 00000000 0000803f cdcccc3d 00000000"
    "00000000 cdcccc3d 00002041 05000000 00000000 0000803f 00000040 00004040 00008040 00000000"
)
SCAN_BIG = bytes.fromhex(
    "00000000 00000001 00000002 00000006 6c61736572000000 00000000 3f800000 3dcccccd 00000000"
    "00000000 3dcccccd 41200000 00000005 00000000 3f800000 40000000 40400000 40800000 00000000"
)

HASH = "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
KEY = f"0/robot3/scan/sensor_msgs::msg::dds_::LaserScan_/{HASH}"
KEY_HUMBLE = "0/robot3/scan/sensor_msgs::msg::dds_::LaserScan_/TypeHashNotSupported"
KEY_BRIDGE = "robot3/scan"
PRESENCE = (
    "@ros2_lv/0/c4c4b6de08baf22f9905d6616ad8f772/0/0/MP/%/%robot3/lidar/%robot3%scan/"
    f"sensor_msgs::msg::dds_::LaserScan_/{HASH}/::,10:,:,:,,"
)
# Rolling says more of publishers of types with uint8[].
PRESENCE_ROLLING = f"{PRESENCE}/cpu"
# With the hash behind the quality of service since Iron.
PRESENCE_BRIDGE = (
    "@/ccadec0e53bdfe8e9e3ea052ab68394e/@ros2_lv/MP/robot3§scan/sensor_msgs§msg§LaserScan/"
    f":1::0,5:typehash={HASH};"
)
# Of bridges before 1.0.
PRESENCE_BRIDGE_0 = (
    "@ros2_lv/8b20917502ee955ac4476e0266340d5c/MP/robot3§scan/sensor_msgs§msg§LaserScan/:1::1,5"
)
