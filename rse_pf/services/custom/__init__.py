"""Services of users in Python, C/C++ or Lua, which an operator installs; a robot never sends code.

The life of such a service:

1. Write: a folder holds the code and ``service.json``, which states name, language, entry file and kind.  The
   kind says whether the service keeps state between the commands of a robot (``per_robot_state``) or not
   (``stateless``).  ``rse-pf service new NAME`` makes such a folder.
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
8. Stop: the sandbox exits some time after the last connection of the robot, or is killed if a command takes
   much longer than its deadline.  If the service has ``snapshot`` and ``restore``, the server stores a
   snapshot of its state after each reply, and the next sandbox of the robot, on the same or another server,
   restores it.

`rse_pf.server.sandbox` isolates the processes.  Nothing of a service is executed before step 6, neither code
of its packages nor a script nor a library.
"""
