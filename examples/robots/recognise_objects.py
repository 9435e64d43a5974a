"""Ask the service of object_recognition_service/ which objects and AprilTags an image shows, and where."""

import argparse
import asyncio
from pathlib import Path

import cv2
import numpy as np

from client_sdk import connect
from client_sdk.cameras import read_intrinsics
from rse_pf.errors import RsePfError, UsageError

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("enrolment", help="file of: rse-pf robot enrol ROBOT --out FILE")
parser.add_argument("image", type=Path, help="a photo, without distortion")
parser.add_argument("--intrinsics", type=Path, default=Path("intrinsics.json"), help="of the camera")
parser.add_argument("--tag-mm", type=float, default=100.0, help="width of the tags' black square")


async def main(args: argparse.Namespace) -> None:
    camera = read_intrinsics(args.intrinsics).camera
    image = cv2.imread(str(args.image), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise UsageError(f"cannot read the image {args.image}", hint="name a photo, such as a .jpg")
    request = {
        "image": cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 90))[1].tobytes(),
        "camera": [camera.fx, camera.fy, camera.cx, camera.cy],
        "tag_m": args.tag_mm / 1e3,
    }
    async with connect(enrolment=args.enrolment, codec="bin") as robot:
        answer = await robot.call("object-recognition", request, deadline_s=10.0)
    for recognised in answer.reply["found"]:
        T_camera_object = np.reshape(recognised["T_camera_object"], (4, 4))
        x, y, z = T_camera_object[:3, 3]
        print(f"{recognised['name']} at {x:.3f} {y:.3f} {z:.3f} m, {recognised['inliers']} inliers")
    print(f"{len(answer.reply['found'])} found, {answer.compute_ms:.0f} ms")


if __name__ == "__main__":
    try:
        asyncio.run(main(parser.parse_args()))
    except RsePfError as error:
        raise SystemExit(str(error)) from None
