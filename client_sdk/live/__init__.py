"""Share one live map with other robots: keyframes go up to the map server, alignments come down.

The way of a keyframe and of its attachments (its coloured points and its image), from the tracker to the live
map and back:

1. `LiveMapper.track` tracks a frame with `client_sdk.mapper.Mapper`; its pose is in the odometry frame.
2. With depth or a stereo pair, a frame 0.1 m or 6 degrees from the last keyframe becomes a keyframe
   (`LiveOptions`).  Of a camera without depth, `monocular_odometry` takes a keyframe of the tracker when two
   newer ones exist: it has settled then.
3. `keyframe_encoding` encodes features, pose, camera, gravity and references to the attachments, in the
   format of `rse_pf.slam.keyframe`; `attachments` encodes the attachments themselves.
4. `keyframe_queue` holds the keyframe, in memory or on disk, until the map server has acknowledged it.
5. `attachments` uploads the attachments to the object store, after pose queries and keyframes.
6. `keyframe_sender` asks for the robot's next keyframe number in the map (``live-show``), and sends the
   oldest keyframe (``live-keyframe``) until the map server acknowledges it, which means that the log of the
   map holds it durably.  A keyframe that is refused for its content is removed instead.
7. While the segment (the robot's present odometry frame) is not aligned to a map that has keyframes of other
   robots, `relocaliser` also asks, with pauses, where in the map the keyframe was made (``live-relocalise``).
8. The map server measures loop closures and optimises its pose graph (`rse_pf.live_map`), and publishes the
   alignment of the newest segment of each robot as an update of the map's topic.
9. `alignments` applies updates and relocalisations, and returns a `Correction` for each change.
10. `LiveMapper` publishes the correction; from the next frame on, ``T_map_camera`` uses the new alignment.

Tracking belongs to `client_sdk.mapper`; the map itself belongs to the map server.
"""

from client_sdk.live.alignments import Correction, OtherRobot
from client_sdk.live.blocking import BlockingLiveMapper
from client_sdk.live.live_mapper import LiveMapper
from client_sdk.live.options import LiveOptions

__all__ = ["BlockingLiveMapper", "Correction", "LiveMapper", "LiveOptions", "OtherRobot"]
