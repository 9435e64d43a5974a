"""The mapping services: cloud alignment, place recognition, localisation, map merge, pose graphs, and Wi-Fi.

This package holds the requests, replies and limits of the services; their algorithms are in `rse_pf.slam`
(but for Wi-Fi localisation, which is here), and maps are stored by `rse_pf.maps`.
"""
