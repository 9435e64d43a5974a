"""Make a map from a camera, a video, a folder of images or a recording; Ctrl-C ends and keeps the map."""

import argparse
import asyncio
from pathlib import Path

from client_sdk import connect
from client_sdk.cameras import open_camera
from rse_pf.errors import RsePfError

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("enrolment", help="file of: rse-pf robot enrol ROBOT --out FILE")
parser.add_argument("source", help="device number (0 is the first camera), video, folder, or realsense")
parser.add_argument("--intrinsics", type=Path, help="intrinsics.json of: rse-pf camera calibrate")
parser.add_argument("--rate", type=float, help="frames per second at most (default: all)")
parser.add_argument("--out", type=Path, default=Path("out-camera"), help="folder of the results")


async def main(args: argparse.Namespace) -> None:
    with open_camera(args.source, intrinsics=args.intrinsics, rate_hz=args.rate) as camera:
        async with connect(enrolment=args.enrolment) as robot:
            mapper = robot.mapper()
            try:
                async for frame in camera:
                    done = await mapper.track(frame)
                    print(f"{frame.timestamp_s:8.3f} s  {done.status}  {done.inliers} inliers  {done.reason}")
            finally:
                report = mapper.save(args.out)
                print(f"{report['frames']} frames, {report['lost_frames']} lost; scale: {report['scale']}")
                print(f"{report['map_points']} points in {args.out}/map.ply")


if __name__ == "__main__":
    try:
        asyncio.run(main(parser.parse_args()))
    except KeyboardInterrupt:
        pass
    except RsePfError as error:
        raise SystemExit(str(error)) from None
