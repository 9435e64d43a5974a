"""HTTP/1.1 of the platform: control ports, connections of services, and connections without a token.

Routes are in `rse_pf.data_server` and in the control plane, WebSockets of robots in `rse_pf.server.gateway`.
"""
