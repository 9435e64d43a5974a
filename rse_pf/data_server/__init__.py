"""The data servers box of Fig. 2: large data by HTTP (Sect. 5.2), and the maps that robots share.

Promises to keep nothing in a process that another data server could not find in the store.
"""

from rse_pf.data_server.app import DataServer
from rse_pf.data_server.maps import MapDiff, MapRecord, MapRegistry, difference
from rse_pf.data_server.openapi import openapi
from rse_pf.data_server.server import serve_data

__all__ = [
    "DataServer",
    "MapDiff",
    "MapRecord",
    "MapRegistry",
    "difference",
    "openapi",
    "serve_data",
]
