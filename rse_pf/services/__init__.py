"""Services that robots call: functions of one typed request that return one typed reply.

`builtin` lists the services of every server, which are adapters of the algorithms in `rse_pf.pnp` and
`rse_pf.slam`; `custom` holds those of users.  Transport, scheduling and isolation are in `rse_pf.wire` and
`rse_pf.server`.
"""
