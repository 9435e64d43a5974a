"""Rigs: the cameras and the IMU of a robot, how they are mounted, and the rectification of stereo pairs.

Calibration files of this and other programs, and checks of calibrations, belong here.  Devices and recordings
belong to `client_sdk.cameras` and `client_sdk.datasets`.
"""
