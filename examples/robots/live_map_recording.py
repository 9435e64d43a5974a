"""Play a recording into a live map that other robots share, and print each place and each correction."""

import argparse
import asyncio

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


async def main(args: argparse.Namespace) -> None:
    async with connect(enrolment=args.enrolment) as robot:
        async with robot.live_map(args.map, spool="keyframes") as mapper:
            telling = asyncio.create_task(tell_corrections(mapper))
            for frame in open_dataset(args.recording).thinned(args.rate):
                done = await mapper.track(frame)
                place = mapper.reason if done.T_map_camera is None else done.T_map_camera[:3, 3].round(2)
                print(f"{done.status}; in the map: {place}; others: {', '.join(mapper.others) or 'none'}")
        await telling
        print(f"{mapper.frames} frames, {mapper.keyframes} keyframes, {mapper.keyframes_waiting} waiting")


if __name__ == "__main__":
    try:
        asyncio.run(main(parser.parse_args()))
    except RsePfError as error:
        raise SystemExit(str(error)) from None
