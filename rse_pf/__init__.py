"""RSE-PF: a robust, secure, elastic cloud robotics platform for distributed visual SLAM.

The core:

- algorithms: `geometry`, `pnp` (poses), `slam`, `maps` (stored versions), `live_map` (shared by robots)
- commands: `wire` (the protocol), `services` (what robots may ask), `native` (the C++ library)
- servers: `server` (backend servers, which robots connect to), `data_server` (maps and files by HTTP)
- places to run: `local` (one machine), `aws`, `scaling` (the rules of both)
- what all need: `config`, `auth`, `audit`, `storage`, `limits`, `http`, `processes`
- `cli`, the command ``rse-pf``; `command_line`, what its verbs share

What the platform works without is in `extensions`.  Modules beside these packages serve several of them.
"""
