"""Define, register and call services.

A service is a function from one typed request to one typed reply; it has no ``self`` and therefore keeps no
state.  `dispatch` calls it for every command, on a backend server, in the Lambda and on the robot
itself.  An exception of a service becomes a `Failure` without the traceback.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import msgspec

from rse_pf.errors import (
    BadMessage,
    BadRequest,
    ConfigurationError,
    InternalError,
    RsePfError,
    UnknownService,
)
from rse_pf.wire import Command, Failure, Result, as_type

__all__ = ["Kind", "Registry", "Report", "Service", "dispatch", "failure_of", "request_of", "unknown_service"]

Kind = Literal["stateless", "per_robot_state", "long"]
"""Kind of a service: short calls without state, calls that keep a state for each robot, or long calls that
run as jobs."""

Report = Callable[[float, str], None]
"""Reports the progress of a long command: the part that is done (0..1), and a text about the last step.

A call raises `Cancelled` if the command was cancelled, so that the service stops its work."""

Function = TypeVar("Function", bound=Callable[..., Any])

# Name of the keyword parameter by which a long service receives a `Report`.
_REPORT = "report"


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """A registered service function, and how a server may run it.

    Attributes:
        name: Name of the service in commands.
        function: Takes a request and returns a reply.
        request_type: Type of the request, a `msgspec.Struct`.
        reply_type: Type of the reply, a `msgspec.Struct`.
        kind: See `Kind`.
        cheap: Whether a server may call the function in its event loop when no command waits.
        reports: Whether the function takes the keyword ``report`` (a `Report`), through which a long service
            reports progress and can be cancelled.
        limited: Whether a request may decode to much more memory or work than its bytes show.  A backend
            server calls the function in a process that has a memory limit and is killed at the deadline.
        warm_up: Called once in such a process before the first request, to import slow modules.
    """

    name: str
    function: Callable[..., Any]
    request_type: type[Any]
    reply_type: type[Any]
    kind: Kind = "stateless"
    cheap: bool = False
    reports: bool = False
    limited: bool = False
    warm_up: Callable[[], object] | None = None

    @property
    def summary(self) -> str:
        """The first line of the function's docstring."""
        return (inspect.getdoc(self.function) or "").split("\n")[0]


class Registry:
    """The services that one process offers."""

    def __init__(self) -> None:
        self._services: dict[str, Service] = {}
        self.others: tuple[str, ...] = ()
        """Names of the services that run in sandboxes; the error about an unknown service lists them, too."""

    def service(
        self,
        name: str,
        *,
        kind: Kind = "stateless",
        cheap: bool = False,
        limited: bool = False,
        warm_up: Callable[[], object] | None = None,
    ) -> Callable[[Function], Function]:
        """Return a decorator that registers a function as the service *name*.

        A function of the kind ``long`` may also take the keyword-only parameter ``report``, a `Report`.  The
        arguments are the attributes of `Service` with the same names.

        Raises:
            ConfigurationError: The name is taken, the function is not annotated with one request and one
                reply type, both `msgspec.Struct`, or a limited service is not stateless or is cheap.
        """
        if limited and (cheap or kind != "stateless"):
            raise ConfigurationError(
                f"service {name!r} is limited, but cheap or not stateless",
                hint="leave out limited, or make the service stateless and not cheap",
            )

        def register(function: Function) -> Function:
            request_type, reply_type = _signature(name, function, kind)
            self.add(
                Service(
                    name=name, function=function, request_type=request_type, reply_type=reply_type,
                    kind=kind, cheap=cheap, limited=limited, warm_up=warm_up,
                    reports=kind == "long" and _REPORT in inspect.signature(function).parameters,
                )
            )  # fmt: skip
            return function

        return register

    def add(self, service: Service) -> None:
        """Register *service*; raises ConfigurationError if another service has its name."""
        if service.name in self._services:
            raise ConfigurationError(f"two services are named {service.name!r}", hint="rename one")
        self._services[service.name] = service

    def get(self, name: str) -> Service:
        """Return the service called *name*; raises UnknownService, which lists the names of all services."""
        service = self._services.get(name)
        if service is None:
            raise unknown_service(name, self.names)
        return service

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all services of this server, including those that run in sandboxes."""
        return (*self._services, *self.others)

    def __iter__(self) -> Iterator[Service]:
        return iter(self._services.values())


def dispatch(
    registry: Registry,
    command: Command,
    clock: Callable[[], float],
    *,
    server: str = "",
    on_defect: Callable[[Command, Exception], None] | None = None,
    report: Report | None = None,
    received_s: float | None = None,
) -> Result | Failure:
    """Call the service that *command* names; return its reply as a Result, or an error as a Failure.

    Each `Exception` and each SystemExit of the service becomes a Failure; none is raised.

    Args:
        registry: The services of this process.
        command: The decoded command; its payload is converted to the service's request type here.
        clock: Returns monotonic seconds; read before and after the call of the service.
        server: Name of this server, which the answer states.
        on_defect: Called with the command and each exception of the service that is no `RsePfError`, for the
            server's log.
        report: Passed to a service that takes ``report``; None calls it without.
        received_s: When the command arrived at a server, by *clock*.  None leaves ``queue_ms``,
            ``received_s`` and ``sent_s`` of the result at 0, as for a command that a robot computes itself.
    """
    started = clock()
    try:
        service = registry.get(command.service)
        request = request_of(command.payload, service)
        if service.reports and report is not None:
            reply = service.function(request, **{_REPORT: report})
        else:
            reply = service.function(request)
    except RsePfError as error:
        return failure_of(error, command, server=server)
    except (Exception, SystemExit) as error:  # noqa: BLE001  a service is untrusted code
        if on_defect is not None:
            exited = RuntimeError(f"the service called exit({error})")
            on_defect(command, error if isinstance(error, Exception) else exited)
        defect = InternalError(
            f"service {command.service!r} failed",
            hint="the server's log has the traceback under the trace id of this command",
        )
        return failure_of(defect, command, server=server)
    ended = clock()
    compute_ms = (ended - started) * 1e3
    if received_s is None:
        return Result(id=command.id, reply=reply, server=server, compute_ms=compute_ms)
    return Result(
        id=command.id, reply=reply, server=server, compute_ms=compute_ms,
        queue_ms=(started - received_s) * 1e3, received_s=received_s, sent_s=ended,
    )  # fmt: skip


def unknown_service(name: str, offered: Iterable[str]) -> UnknownService:
    """Return the error for a command whose service *name* is none of the names *offered*."""
    return UnknownService(
        f"no service named {name!r}; this server offers {', '.join(offered) or 'none to you'}",
        hint="check the spelling, or install the service on the server",
    )


def failure_of(error: RsePfError, command: Command | None = None, *, server: str = "") -> Failure:
    """Return the message that reports *error* to a robot.

    It has the id and the trace of *command*; without *command* it concerns the whole session.
    """
    return Failure(
        id=None if command is None else command.id,
        code=error.code,
        message=error.message,
        hint=error.hint,
        retry_after_ms=error.retry_after_ms,
        server=server,
        trace="" if command is None else command.trace,
    )


def request_of(payload: Any, service: Service) -> Any:
    """Return a command's *payload* converted to the request type of *service*; None counts as empty.

    Raises:
        BadRequest: The payload does not fit the request type.
    """
    if type(payload) is service.request_type:
        return payload
    try:
        return as_type({} if payload is None else payload, service.request_type)
    except BadMessage as error:
        raise BadRequest(
            f"{service.name}: {error.message}", hint=error.hint or "see the service's request type"
        ) from error


def _signature(name: str, function: Callable[..., Any], kind: Kind) -> tuple[type[Any], type[Any]]:
    """Return the request type and the reply type of *function* by its annotations.

    Raises:
        ConfigurationError: *function* does not take one `msgspec.Struct` and return one, apart from the
            keyword-only ``report`` of a long service.
    """
    try:
        hints = typing.get_type_hints(function)
    except (NameError, TypeError, AttributeError) as error:
        raise ConfigurationError(
            f"service {name!r} has annotations that cannot be read: {error}",
            hint="define its request and reply types at the top of the module",
        ) from error
    reply_type = hints.pop("return", None)
    parameters = dict(inspect.signature(function).parameters)
    if (
        kind == "long"
        and _REPORT in parameters
        and parameters[_REPORT].kind is inspect.Parameter.KEYWORD_ONLY
    ):
        parameters.pop(_REPORT)
        hints.pop(_REPORT, None)
    kinds = list(hints.values())
    if (
        len(parameters) != 1
        or len(kinds) != 1
        or not all(
            isinstance(kind, type) and issubclass(kind, msgspec.Struct) for kind in (*kinds, reply_type)
        )
    ):
        raise ConfigurationError(
            f"service {name!r} must take one msgspec.Struct and return one",
            hint="write def f(request: MyRequest) -> MyReply",
        )
    return kinds[0], typing.cast("type[Any]", reply_type)
