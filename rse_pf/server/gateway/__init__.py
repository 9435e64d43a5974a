"""The gateway of a worker: from an accepted socket to a submitted command, and back to the robot.

A command takes these steps:

1. `websocket.Listener` gets a frame from the socket, and `connection.RobotConnection` assembles messages of
   frames (`frames`).
2. `dispatcher.Dispatcher` refuses the message by the rate of its robot (`rate_limits`) or by the backlog of
   the server (`scheduling.overload`), or has it decoded.
3. `admission.Admission` admits or refuses the decoded command.
4. The first queue that offers its service takes it: `service_queues` for services that this worker computes,
   else a sandbox, a job or a live map.  `scheduling.scheduler` decides which command of a queue is computed
   next.
5. `answers.Answers` calls the service, and encodes, counts and logs the answer.
6. `RobotConnection` writes the answer through `websocket.Listener`.

Sockets, handshakes, connections and admission belong here; the order of commands belongs to `scheduling`.
"""
