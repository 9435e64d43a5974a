"""The mapping services: alignment, place recognition, localisation, map merge and pose graphs.

Pure functions over maps and clouds belong here; storage belongs to `rse_pf.maps`.
"""
