"""The inside of a worker: from an accepted socket to a dispatched command and its answer.

Sockets, handshakes, connections and admission belong here; the order of commands belongs to `scheduling`.
"""
