"""Rigs: the cameras and the IMU of a robot, how they are mounted, and the rectification of stereo pairs.

This package reads and writes calibration files of RSE-PF (``intrinsics.json``, ``rig.json``), reads those of
other programs, and checks stereo pairs.  Devices and recordings belong to `client_sdk.cameras` and
`client_sdk.datasets`.
"""
