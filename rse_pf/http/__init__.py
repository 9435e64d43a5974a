"""HTTP/1.1 of the platform: control ports, the connections of HTTP services, and unauthenticated connections.

The routes are in `rse_pf.data_server` and in the control plane; the WebSockets of robots are in
`rse_pf.server.gateway`.
"""
