"""Trackers: the pose of a camera for each frame, and the map of keyframes and landmarks behind the poses.

`client_sdk.tracking.tracker` is for cameras with depth and stereo pairs,
`client_sdk.tracking.monocular_tracker` for one lens without depth.  Both are given frames, and read neither
cameras nor files.  To get a pose, both return a pose query (points and the pixels that show them); the caller
has it answered by the PnP service of a server, or by the same solver on the robot, and returns the answer.

A segment is a stretch of a drive whose poses are in one world frame.  It begins with the first frame, or
where no known place was recognised for too long, and ends when it is joined to an older segment.
"""
