"""The mapping services: align, find places, localise, merge and optimise maps, with their algorithms.

Pure functions over maps and clouds belong here; storage belongs to `rse_pf.maps`.
"""
