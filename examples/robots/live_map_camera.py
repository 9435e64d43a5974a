"""Drive with a depth camera in a live map that other robots share; Ctrl-C leaves the map."""

import argparse
import asyncio
from pathlib import Path

from client_sdk import connect
from client_sdk.cameras import open_camera
from rse_pf.errors import RsePfError

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("enrolment", help="file of: rse-pf robot enrol ROBOT --out FILE")
parser.add_argument("source", help="realsense, or a folder of images with depth")
parser.add_argument("--intrinsics", type=Path, help="intrinsics.json of: rse-pf camera calibrate")
parser.add_argument("--map", default="warehouse", help="name of the live map (default: warehouse)")


async def main(args: argparse.Namespace) -> str | None:
    with open_camera(args.source, intrinsics=args.intrinsics) as camera:
        async with connect(enrolment=args.enrolment) as robot, robot.live_map(args.map, depth=True) as mapper:
            async for frame in camera:
                done = await mapper.track(frame)
                if done.corrected:
                    print(f"the map corrected this robot: {mapper.aligned_by}, {mapper.reason}")
                print(f"{done.status} {mapper.state}: {done.T_map_camera}")
        if mapper.keyframes_waiting:
            return f"{mapper.keyframes_waiting} keyframes did not reach the map"
        return None


if __name__ == "__main__":
    try:
        raise SystemExit(asyncio.run(main(parser.parse_args())))
    except KeyboardInterrupt:
        pass
    except RsePfError as error:
        raise SystemExit(str(error)) from None
