"""Geometry of one camera without depth: two-view start, bundle adjustment, scale.

Functions over arrays of pixels, points and poses belong here, and how OpenCV is loaded; frames, features and
queries do not.
"""
