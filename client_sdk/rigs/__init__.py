"""Rigs: what cameras and IMU a robot carries, how they are mounted, and stereo pairs that are rectified.

Lenses, files of calibrations and the checks of them belong here; devices and recordings do not.
"""
