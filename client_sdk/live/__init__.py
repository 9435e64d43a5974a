"""The robot's side of a live map: keyframes up, alignments down, one `LiveMapper` for both.

Tracking belongs to `client_sdk.mapper`; the map itself and its owner belong to the servers.
"""

from client_sdk.live.alignments import Correction, OtherRobot
from client_sdk.live.blocking import BlockingLiveMapper
from client_sdk.live.mapper import LiveMapper
from client_sdk.live.options import LiveOptions

__all__ = ["BlockingLiveMapper", "Correction", "LiveMapper", "LiveOptions", "OtherRobot"]
