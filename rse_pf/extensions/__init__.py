"""Extensions: packages that the platform does not need.  They import the core; the core imports none of them.

They are experiments with load generator and fault injection, recording and replay of messages, the check of
drives, the fleet page, exports of maps, the rosbridge server, estimates of cost, and merges on a Dask
cluster.  The module ``command`` of an extension defines its verb of the command line.
"""
