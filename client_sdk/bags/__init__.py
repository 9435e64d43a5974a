"""Read ROS bags (ROS 1 bag, ROS 2 sqlite3, ROS 2 MCAP) as frames, and write maps as bags, without ROS.

All code that depends on ROS message types is in this package.
"""

from client_sdk.bags.bag import Bag, BagOptions, open_bag
from client_sdk.bags.lens import lens_or_rig
from client_sdk.bags.writer import BagKind, BagWriter, write_map_bag
from rse_pf.geometry import Lens

__all__ = [
    "Bag", "BagKind", "BagOptions", "BagWriter", "Lens", "lens_or_rig", "open_bag", "write_map_bag",
]  # fmt: skip
