"""RSE-PF: a robust, secure, elastic cloud robotics platform for distributed visual SLAM.

The core:

- algorithms: `geometry`, `pnp` (poses), `slam`, `maps` (stored versions), `live_map` (shared by robots)
- commands: `wire` (the protocol), `services` (what robots may ask), `native` (the C++ library)
- servers: `server` (backend servers, which robots connect to), `data_server` (maps and files by HTTP)
- places to run: `local` (one machine), `aws`, `scaling` (the rules of both)
- used by all of these: `config`, `auth`, `audit`, `storage`, `limits`, `http`, `processes`
- `cli`, the command ``rse-pf``; `command_line`, the code that several of its verbs use

Packages without which the platform works are in `extensions`.  The modules directly in this package are used
by several packages.
"""
