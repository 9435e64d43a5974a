"""The gateway of a worker: it accepts the sockets of robots, submits their commands, and returns the answers.

A command takes these steps:

1. `websocket.Listener` gets a WebSocket frame from the socket, and `connection.RobotConnection` assembles
   frames to messages (`frames`).
2. `dispatcher.Dispatcher` refuses the message if its robot exceeds its rate (`rate_limits`) or if the server
   is overloaded (`scheduling.overload`).  Otherwise the message is decoded.
3. `admission.Admission` admits or refuses the decoded command.
4. The first queue that offers the service of the command takes it.  The queues are those of sandboxes, live
   maps, limited services, jobs and stateless services (`service_queues`).  `scheduling.scheduler` decides
   which command of a `service_queues` queue is computed next.
5. `answers.Answers` calls the service, and encodes, counts and logs the answer.
6. `RobotConnection` writes the answer through `websocket.Listener`.

Sockets, handshakes, connections and admission belong to this package; the order of commands belongs to
`scheduling`.
"""
