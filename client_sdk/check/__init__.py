"""Find what is wrong with a drive: its calibration, its times, its images, and how its sensors fit.

Adjusting a drive with its calibration belongs to `rse_pf.slam`; what the command line prints belongs there.
"""
