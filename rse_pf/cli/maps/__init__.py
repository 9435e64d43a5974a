"""The verbs map and camera: maps that robots share, maps from cameras and bags, live maps, calibration.

Options and printed text belong here; the work is in `client_sdk` and `rse_pf.maps`.
"""
