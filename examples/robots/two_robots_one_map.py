"""Let two robots map with cameras that have depth, share their maps, and merge them into one on a server.

In practice each robot runs `drive` by itself, and any of them merges.  The server needs the extra maps.
"""

import argparse
import asyncio
from pathlib import Path

from client_sdk import DataClient, connect, merge_maps
from client_sdk.cameras import open_camera
from client_sdk.point_map import write_ply
from rse_pf.errors import RsePfError
from rse_pf.maps.format import decode_map

parser = argparse.ArgumentParser(description=__doc__)
FILE = "file of rse-pf robot enrol ROBOT --out FILE"
for robot in ("first", "second"):
    parser.add_argument(f"{robot}_enrolment", help=f"{robot} robot: {FILE}")
    parser.add_argument(f"{robot}_source", help=f"{robot} robot: recording, folder with depth, or realsense")
parser.add_argument("--out", type=Path, default=Path("merged.ply"), help="the merged cloud")


async def drive(enrolment: str, source: str, name: str) -> None:
    """Track all frames of *source*, and share the map as *name*."""
    with open_camera(source) as camera:
        async with connect(enrolment=enrolment) as robot:
            mapper = robot.mapper(keyframes_of=name)
            async for frame in camera:
                await mapper.track(frame)
    version = await asyncio.to_thread(DataClient.enrolled(enrolment).update_map, name, mapper.encoded_map())
    print(f"{name}: {mapper.keyframes} keyframes, {mapper.lost_frames} frames lost, shared as {version[:12]}")


async def main(args: argparse.Namespace) -> None:
    await asyncio.gather(
        drive(args.first_enrolment, args.first_source, "first"),
        drive(args.second_enrolment, args.second_source, "second"),
    )
    data = DataClient.enrolled(args.first_enrolment)
    maps = [await asyncio.to_thread(data.download_map, name) for name in ("first", "second")]
    async with connect(enrolment=args.first_enrolment) as robot:
        reply = await merge_maps(robot, data, maps)
    for refusal in reply.not_joined:
        print(f"map {refusal.map + 1} was not joined: {refusal.reason}")
    merged = decode_map(reply.map)
    write_ply(args.out, merged.points, merged.colours)
    print(f"{len(reply.joined)} maps joined, {reply.merges} links: {len(merged.points)} points in {args.out}")


if __name__ == "__main__":
    try:
        asyncio.run(main(parser.parse_args()))
    except RsePfError as error:
        raise SystemExit(str(error)) from None
