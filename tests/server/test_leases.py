"""Leases of jobs and of live maps in random schedules: never do two holders write one after the other."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable

import pytest

from rse_pf.errors import Conflict, NotFound, StoreError
from rse_pf.server.jobs.lease import JobLease, JobRecord
from rse_pf.server.jobs.lease import verdict_on as verdict_on_job
from rse_pf.server.live_map.lease import MapLease, decode_lease
from rse_pf.server.live_map.lease import next_action as verdict_on_map
from rse_pf.storage.lease import Lease

LEASE_S = 1.5
NAME = "lease"
SCHEDULES = 5_000
STEPS = 30
STALLS = 0.25
"""Of the store's operations, others happen before or after so many; the process stalls meanwhile."""
LOST = 0.04
"""So many answers of the store are lost; half of these writes were done."""


class World:
    """A store of one record, and the processes that use it."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.now_s = 0.0
        self.processes: list[Process] = []
        self.holder: Process | None = None
        self.accepted: list[tuple[str, str]] = []
        self._stored: bytes | None = None
        self._depth = 0

    def clock(self) -> float:
        return self.now_s

    def stall(self) -> None:
        """Let others go on, and time pass, while the process that is here waits."""
        if self._depth < 3 and self.random.random() < STALLS:
            self._depth += 1
            self.now_s += self.random.choice((0.1, 1.0, 2.0))
            self.step()
            self._depth -= 1

    def step(self) -> None:
        free = [process for process in self.processes if not process.is_busy]
        if free:
            self.random.choice(free).step()

    def get(self, name: str) -> bytes:
        self.stall()
        found = self._stored
        self.stall()
        if found is None:
            raise NotFound("no record")
        return found

    def swap(self, process: Process, expected: bytes | None, data: bytes) -> None:
        self.stall()
        is_lost = self.random.random() < LOST
        if is_lost and self.random.random() < 0.5:
            raise StoreError("the store did not answer")
        if self._stored != expected:
            raise Conflict("another record")
        self._stored = data
        self._accept(process)
        self.stall()
        if is_lost:
            raise StoreError("the answer was lost")

    def _accept(self, process: Process) -> None:
        """Note a write that was done: only who claimed last may write, until another claims."""
        self.accepted.append((process.name, process.action))
        if process.action == "claim":
            self.holder = process
        elif process.action != "cancel":
            assert self.holder is process, f"{process.action} of {process.name}: {self.accepted}"
        if process.action == "end":
            self.holder = None


class Process:
    """One process: it watches the record, and claims, renews and ends a lease of its own."""

    def __init__(self, world: World, name: str) -> None:
        self.name = name
        self.action = ""
        self.is_busy = False
        self.world = world
        self.holds = self.is_ending = False

    def get(self, name: str) -> bytes:
        return self.world.get(name)

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        self.world.swap(self, expected, data)

    def step(self) -> None:
        self.is_busy = True
        try:
            self.act()
        except StoreError:
            pass  # it knows nothing, and tries again with a later step
        finally:
            self.is_busy = False

    def act(self) -> None:
        raise NotImplementedError

    def do(self, action: str, write: Callable[[], bool]) -> bool:
        """Write; what is reported as done was accepted as a write of this process."""
        self.action = action
        before = len(self.world.accepted)
        is_done = write()
        if is_done:
            own = [each for each in self.world.accepted if each == (self.name, action)]
            assert own, f"{action} of {self.name} was reported, but not done since {before}"
        return is_done


class JobProcess(Process):
    """A server that runs a job, follows it, or cancels it."""

    def __init__(self, world: World, name: str) -> None:
        super().__init__(world, name)
        self.lease = JobLease(self, NAME, name, world.clock)

    def act(self) -> None:
        lease, chance = self.lease, self.world.random.random()
        if self.holds:
            if chance < 0.7 and not self.is_ending:
                self.holds = self.do("renew", lambda: lease.renew(0.5, "half")) or lease.is_ours
            else:
                self.is_ending = True
                self.do("end", lambda: lease.end(JobRecord(state="given-up", owner="")))
                self.holds = self.is_ending = False
            return
        record = lease.read()
        verdict = verdict_on_job(record, unchanged_s=lease.unchanged_s, lease_s=LEASE_S, is_watched=False)
        if verdict in ("take", "poison"):
            self.holds = self.do("claim", lease.take)
        elif chance < 0.1:
            self.action = "cancel"
            lease.ask_to_cancel()


class OwnerProcess(Process):
    """A server that owns a live map, or watches its owner."""

    def __init__(self, world: World, name: str) -> None:
        super().__init__(world, name)
        self.watch = Lease(self, NAME, decode_lease, world.clock)
        self.claims = 0

    def act(self) -> None:
        world = self.world
        if not self.holds:
            self.watch.read()
            verdict = verdict_on_map(self.watch.record, unchanged_s=self.watch.unchanged_s, lease_s=LEASE_S)
            if verdict == "claim":
                self.claims += 1
                owner = f"{self.name}-{self.claims}"
                self.lease = MapLease(self, NAME, owner=owner, server=self.name, clock=world.clock)
                self.holds = self.do("claim", lambda: self.lease.claim(self.watch.known))
            return
        choices = [
            ("renew", self.lease.renew),
            ("renew", lambda: self.lease.serve("127.0.0.1", 1, "c")),
            ("end", self.lease.release),
        ]
        action, write = choices[2] if self.is_ending else world.random.choices(choices, (6, 2, 1))[0]
        self.is_ending = action == "end"
        is_done = self.do(action, write)
        self.holds, self.is_ending = is_done and action != "end", False


@pytest.mark.parametrize("kind", [JobProcess, OwnerProcess])
def test_in_10_000_schedules_with_stalls_no_two_holders_have_accepted_writes(kind: type[Process]) -> None:
    claims = lost = 0
    for seed in range(SCHEDULES):
        world = World(seed)
        world.processes = [kind(world, name) for name in ("a", "b", "c")]
        for _ in range(STEPS):
            world.now_s += world.random.choice((0.0, 0.2, 0.5))
            world.step()
        holders = [name for name, action in world.accepted if action == "claim"]
        claims += len(holders)
        lost += sum(first != second for first, second in itertools.pairwise(holders))

    assert claims > 2 * SCHEDULES, "leases are claimed again and again"
    assert lost > SCHEDULES, "and by different processes"
