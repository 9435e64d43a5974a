"""Inertial measurement units: their samples, the motion that they measure, and what it tells of a drive.

Rotation between frames, metres, gravity and biases belong here; frames, tracking and the wire do not.
"""
