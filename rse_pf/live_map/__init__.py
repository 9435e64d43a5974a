"""One map that several robots build together while they drive: events in, outcomes out, deterministic.

1. `events` are the inputs: a robot's keyframe, measured loop closures, an optimisation, and others.
2. `live_map.LiveMap.apply` changes the map by an event and returns `outcomes`.
3. `candidates` and `measure` find and measure loop closures; the result is an event.
4. `outlier_rejection` decides which loop closures are right, by the tests of `pairwise_consistency`, and
   which robots contradict the map.  It reads the graph and returns `decisions`; it changes nothing.
5. `smoothing` fits the poses around what changed, and `alignment_reports` says which alignments changed.
6. `graph.MapGraph` owns the pose graph and carries out the decisions; `graph_rows` are its rows, `snapshots`
   are its bytes.
7. `versions` publishes the map to the registry of maps, and starts a live map from a published one.

Nothing here knows the time, a store, a connection or a thread; `rse_pf.server.live_map` does.
"""
