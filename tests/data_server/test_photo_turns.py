"""A photo waits for nobody who used more CPU time of late, and who used much is refused at the door."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fake_data_service import Service, small_settings

from rse_pf.child.limited import CallWatch, LimitedProcesses, Overran, ProcessLimits
from rse_pf.data_server.photo_localiser import PhotoLocaliser
from rse_pf.data_server.photo_turns import PhotoTurns, RecentUse
from rse_pf.errors import BadRequest
from rse_pf.identity import RobotId
from rse_pf.maps.photos import Lens, PhotoLocation
from rse_pf.object_store import MemoryStore

LONG_S = 20.0
ROBOT, SISTER, OTHER = RobotId("acme", "robot-1"), RobotId("acme", "robot-2"), RobotId("rival", "robot-1")


class Server:
    """Turns of one process at a time, whose clock and signals are seen."""

    def __init__(self, at_once: int = 1) -> None:
        self.now = 0.0
        self.paused: set[int] = set()
        self.due: list[Callable[[], None]] = []
        self.turns = PhotoTurns(
            lambda: self.now, at_once=at_once, send_signal=self.send, judge_later=self.due.append
        )
        self._pids = iter(range(1, 1000))

    def send(self, pid: int, number: int) -> None:
        assert (pid in self.paused) == (number == signal.SIGCONT), "no signal without effect"
        self.paused.symmetric_difference_update({pid})

    @contextmanager
    def working(self, robot: RobotId) -> Iterator[int]:
        pid = next(self._pids)
        with self.turns.call_of(robot).working(pid):
            yield pid

    def wait(self, seconds: float) -> None:
        self.now += seconds
        due, self.due[:] = list(self.due), []
        for judge in due:
            judge()


@pytest.fixture
def server() -> Server:
    return Server()


def test_who_used_more_of_late_is_paused_until_the_other_ends(server: Server) -> None:
    server.turns.call_of(ROBOT).used(2.0)

    with server.working(ROBOT) as flood:
        assert not server.paused
        with server.working(OTHER):
            assert server.paused == {flood}
        assert not server.paused


def test_who_used_less_goes_on_beside_a_newcomer_who_used_more(server: Server) -> None:
    server.turns.call_of(OTHER).used(2.0)

    with server.working(ROBOT), server.working(OTHER) as late:
        assert server.paused == {late}
    assert not server.paused


def test_the_robots_of_one_tenant_count_together_and_then_each_for_itself(server: Server) -> None:
    server.turns.call_of(SISTER).used(2.0)
    server.turns.call_of(OTHER).used(1.0)

    with server.working(ROBOT) as first, server.working(OTHER):
        assert server.paused == {first}, "its tenant used more"
    with server.working(SISTER) as second, server.working(ROBOT):
        assert server.paused == {second}


def test_long_work_gives_way_when_it_has_used_more(server: Server) -> None:
    server.turns.call_of(OTHER).used(1.1)

    with server.working(ROBOT) as long, server.working(OTHER) as short:
        assert server.paused == {short}
        server.wait(0.9)
        assert server.paused == {short}
        server.wait(0.9)
        assert server.paused == {long}
        server.wait(60.0)
    assert not server.paused
    server.wait(1.0)
    assert not server.due, "nobody waits, so nothing is judged again"


def test_several_work_at_once_where_there_are_processors() -> None:
    server = Server(at_once=2)
    robots = [RobotId("acme", f"robot-{number}") for number in range(4)]
    for number, robot in enumerate(robots):
        server.turns.call_of(robot).used(0.5 * number)

    with ExitStack() as stack:
        pids = [stack.enter_context(server.working(robot)) for robot in reversed(robots)]
        assert server.paused == set(pids[:2])


def test_a_share_counts_for_nothing_and_what_is_counted_is_bounded() -> None:
    use = RecentUse()
    for second in range(100):
        use.add("a", 0.12, now=second)
    assert use.of("a", now=100.0) == 0.0

    use.add("a", 1.0, now=100.0)
    assert use.of("a", now=104.0) == pytest.approx(0.5)
    use.add("a", 1000.0, now=104.0)
    assert use.of("a", now=104.0) == pytest.approx(2.0)
    for number in range(20_000):
        use.add(number, 1.0, now=104.0)
    assert len(use) == 10_000
    assert use.of("a", now=104.0) == 0.0


def test_a_newcomer_does_not_go_before_who_used_no_more_than_its_share(server: Server) -> None:
    server.turns.call_of(OTHER).used(0.04)
    server.now += 0.5

    with server.working(ROBOT) as newcomer:
        server.now += 0.01
        with server.working(OTHER):
            assert server.paused == {newcomer}


def state_of(pid: int) -> str:
    """Return the state of a process as the kernel names it; T is stopped."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def wait_for(what: Callable[[], bool]) -> None:
    until = time.monotonic() + LONG_S
    while not what():
        assert time.monotonic() < until
        threading.Event().wait(0.005)


def test_a_process_is_stopped_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "naps.py").write_text(
        "import time\n\ndef make(configuration):\n    return lambda data: time.sleep(60) or b''\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    turns, pids = PhotoTurns(time.monotonic, at_once=1), dict[RobotId, int]()
    turns.count(ROBOT, 100.0)

    class Watch:
        def __init__(self, robot: RobotId) -> None:
            self.robot, self.call = robot, turns.call_of(robot)

        def working(self, pid: int) -> Any:
            pids[self.robot] = pid
            return self.call.working(pid)

        def used(self, cpu_s: float) -> None:
            self.call.used(cpu_s)

    def call(robot: RobotId, timeout_s: float) -> None:
        with pytest.raises(Overran):
            processes.call(b"", timeout_s, watch=Watch(robot))

    with LimitedProcesses("naps:make", ProcessLimits(memory_bytes=64 << 20), count=2) as processes:
        hog = threading.Thread(target=call, args=(ROBOT, 3.0))
        hog.start()
        wait_for(lambda: ROBOT in pids)
        other = threading.Thread(target=call, args=(OTHER, 1.0))
        other.start()
        wait_for(lambda: state_of(pids[ROBOT]) == "T")
        assert state_of(pids[OTHER]) != "T"
        other.join(LONG_S)
        wait_for(lambda: state_of(pids[ROBOT]) != "T")
        hog.join(LONG_S)


class Localiser:
    """Takes as much CPU time as it is told."""

    count = 1

    def __init__(self) -> None:
        self.cpu_s, self.calls = 0.0, 0

    def localise(
        self, robot: RobotId, name: str, photo: bytes, lens: Lens, charge: Callable[[float], None]
    ) -> PhotoLocation:
        self.calls += 1
        charge(self.cpu_s)
        if photo == b"bad":
            raise BadRequest("this is no photo", hint="send one")
        return PhotoLocation(version="ab", verdict="lost")

    def close(self) -> None:
        """End nothing."""


class PhotoService(Service):
    def photo(self, data: bytes = b"photo", robot: str = "robot-1") -> Any:
        query = "fx=500&fy=500&cx=320&cy=240"
        return self.ask("POST", "/localise/rooms", data, query=query, robot=robot)


@pytest.mark.parametrize(("data", "status"), [(b"photo", 200), (b"bad", 400)])
def test_who_used_its_cpu_time_is_refused_before_a_photo_is_read(data: bytes, status: int) -> None:
    localiser = Localiser()
    service = PhotoService(small_settings(max_requests_per_s=50), MemoryStore(), localiser=localiser)
    localiser.cpu_s = 0.9  # of the 250 ms a second that 50 requests a second are

    assert service.photo(data).status == status
    assert service.photo(data).status == status, "20 of 200 requests are left, of which it takes ten"
    refused = service.photo()

    assert (refused.status, localiser.calls) == (429, 2)
    assert int(refused.headers["retry-after"]) in (3, 4)
    assert service.photo(robot="robot-2").status == 200
    service.now += 3.5
    assert service.photo().status == 200


def test_a_photo_never_counts_for_more_than_what_may_come_at_once() -> None:
    localiser = Localiser()
    service = PhotoService(small_settings(max_requests_per_s=50), MemoryStore(), localiser=localiser)
    localiser.cpu_s = 20.0  # the first photo of a large map

    assert service.photo().status == 200
    service.now += 0.1
    assert service.photo().status == 200
    refused = service.photo()
    assert int(refused.headers["retry-after"]) <= 5


def test_photos_that_take_little_count_as_ten_requests() -> None:
    localiser = Localiser()
    service = PhotoService(small_settings(max_requests_per_s=50), MemoryStore(), localiser=localiser)
    localiser.cpu_s = 0.03

    assert [service.photo().status for _ in range(21)] == [200] * 20 + [429]


class _BrokenProcesses:
    """Processes of which each takes 0.3 s of CPU time, and fails."""

    count, private_store = 1, None

    def call(self, robot: RobotId, data: bytes, *, near: str, watch: CallWatch) -> bytes:
        watch.used(0.3)
        raise BadRequest("no image")


def test_a_photo_that_fails_is_charged_for_what_it_took(server: Server) -> None:
    localiser = PhotoLocaliser(_BrokenProcesses(), server.turns)  # type: ignore[arg-type]
    charged: list[float] = []

    with pytest.raises(BadRequest):
        localiser.outline(ROBOT, "hall", charged.append)

    assert charged == [0.3]
