"""Find faults of a recorded drive: wrong calibration, wrong time stamps, bad images, sensors that disagree.

The bundle adjustment that estimates the calibration is `rse_pf.slam.self_calibration`; the command
``rse-pf check`` is `rse_pf.extensions.check`.
"""
