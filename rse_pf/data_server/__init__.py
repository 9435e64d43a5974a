"""The data servers box of Fig. 2: large data by HTTP (Sect. 5.2), and the maps that robots share.

HTTP, uploads and quotas belong here.  A process keeps no state that another data server could not read from
the store.
"""

from rse_pf.data_server.app import DataServer
from rse_pf.data_server.routes import openapi
from rse_pf.data_server.server import serve_data

__all__ = ["DataServer", "openapi", "serve_data"]
