"""Serve live maps: maps that robots make together while they drive.

The map itself, without processes and connections, is `rse_pf.live_map`.  Here, one process (the map server)
changes each map, and the workers of all backend servers pass requests of robots to it.  A keyframe takes
these steps:

1. `router.LiveMapRouter` (worker) checks the scope of the robot's token, and size and format of the keyframe.
2. `client.LiveMapClient` (worker) has one `map_connection.MapConnection` for each map.
3. `MapConnection` reads the lease of the map in the object store (`lease`) and connects to its map server, or
   lets a process of `process_pool` claim the map.  The worker authenticates itself to the map server by a
   token, and the map server to the worker by its certificate (`connection_security`).
4. `map_server.worker_connections` (map server) receives the request.
5. `map_server.requests.RequestHandler` validates the keyframe against the map and charges the quota.
6. `map_server.log.LogWriter` writes the keyframe durably into the next entry of the log.
7. `map_server.map_server.MapServer` applies the entry to the map (`map_server.state`); only then is the robot
   answered, over the same connections.
8. After the answer, `map_server.measurement` measures the loop closures of the keyframe; they enter the log
   as in step 6.
9. `MapServer` applies them and sends the alignments that changed (`map_server.messages`) to all workers.
10. `subscriptions.Subscriptions` (worker) sends the newest update of each key to every subscribed robot.
"""
