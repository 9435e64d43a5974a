"""Ask the cloud first, and compute on the robot while the cloud is gone, late, or not there yet."""

import argparse
import asyncio
import itertools

from client_sdk import CloudFirst, connect
from rse_pf.errors import RsePfError
from rse_pf.pnp.problems import make_problem

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("enrolment", help="file of: rse-pf robot enrol ROBOT --out FILE")
parser.add_argument("--rate", type=float, default=5.0, help="frames per second (default: 5)")


def changed(what: str, why: str) -> None:
    """Print ``link-lost``, ``link-back`` or ``moved``, and the reason or the server."""
    print(f"-- {what}: {why}")


async def main(args: argparse.Namespace) -> None:
    async with connect(enrolment=args.enrolment, offload=CloudFirst(), on_change=changed) as robot:
        for row in itertools.count():
            frame = make_problem(seed=row)
            answer = await robot.solve_pnp(frame.points_world, frame.pixels, frame.camera, deadline_s=1.0)
            why = f" ({answer.why})" if answer.why else ""
            print(f"frame {row}: pose by the {answer.source}{why}, {answer.round_trip_ms:.1f} ms")
            await asyncio.sleep(1.0 / args.rate)


if __name__ == "__main__":
    try:
        asyncio.run(main(parser.parse_args()))
    except KeyboardInterrupt:
        pass
    except RsePfError as error:
        raise SystemExit(str(error)) from None
