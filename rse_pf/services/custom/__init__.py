"""Services of users in Python, C/C++ or Lua, which an operator installs; a robot never sends code.

The life of such a service:

1. Write: a folder holds ``service.json`` (name, language, entry file, kind) and the code; ``rse-pf service
   new NAME`` makes one.
2. Build: the Python packages of ``requirements.txt`` are installed from wheels with known hashes
   (`dependencies`).
3. Install: the regular files are copied to the services folder of a server, with a SHA-256 for each
   (`installed`).
4. Publish (AWS only): an archive and a list are uploaded, which all servers follow (`publishing`).
5. Verify: a server that starts compares all files with their hashes (`installed`); the parent process of the
   sandboxes copies them and compares the copy (`verified_copy`).
6. Load: a sandbox, one process for each robot, loads the copy by the language's runtime (`runtime`, `cpp`,
   `lua`).
7. Run: the sandbox calls the service for each command; what the service prints is limited and logged
   (`output`).
8. Stop: the sandbox exits with the robot's connection, or is killed at a deadline; a service with snapshots
   continues on another server.

`rse_pf.server.sandbox` isolates the processes; this package executes nothing of a service before step 6.
"""
