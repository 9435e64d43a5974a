"""Play a recording into a live map that other robots share, and print each place and each correction.

Keyframes that the map has not acknowledged wait in a folder that is named for the robot's enrolment.  If some
are left at the end, the program says so and exits with 1; the next drive sends them first.
"""

import argparse
import asyncio
from pathlib import Path

from client_sdk import LiveMapper, connect, open_dataset
from rse_pf.errors import RsePfError

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("enrolment", help="file of: rse-pf robot enrol ROBOT --out FILE")
parser.add_argument("recording", help="folder in TUM layout, with depth")
parser.add_argument("--map", default="warehouse", help="name of the live map (default: warehouse)")
parser.add_argument("--rate", type=float, default=10.0, help="frames per second (default: 10)")


async def tell_corrections(mapper: LiveMapper) -> None:
    async for change in mapper.corrections():
        print(f"correction of segment {change.segment} by {change.by}, because of {change.cause}")


async def main(args: argparse.Namespace) -> str | None:
    spool = Path("keyframes") / Path(args.enrolment).stem  # each robot has its own
    async with connect(enrolment=args.enrolment) as robot:
        async with robot.live_map(args.map, spool=spool) as mapper:
            telling = asyncio.create_task(tell_corrections(mapper))
            for frame in open_dataset(args.recording).thinned(args.rate):
                done = await mapper.track(frame)
                place = mapper.reason if done.T_map_camera is None else done.T_map_camera[:3, 3].round(2)
                print(f"{done.status}; in the map: {place}; others: {', '.join(mapper.others) or 'none'}")
        await telling
        print(f"{mapper.frames} frames, {mapper.keyframes} keyframes, {mapper.keyframes_waiting} waiting")
        drive = mapper.report()["live"]
        lost = drive["keyframes_dropped"] + drive["keyframes_refused"]
        if mapper.keyframes_waiting or lost:
            return f"{mapper.keyframes_waiting} keyframes wait in {spool}, {lost} are lost"
        return None


if __name__ == "__main__":
    try:
        raise SystemExit(asyncio.run(main(parser.parse_args())))
    except RsePfError as error:
        raise SystemExit(str(error)) from None
