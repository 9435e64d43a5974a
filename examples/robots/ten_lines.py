"""Connect, ask for one camera pose, and print it."""

import argparse
import asyncio

from client_sdk import connect
from rse_pf.errors import RsePfError
from rse_pf.pnp.problems import make_problem

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("enrolment", help="file of: rse-pf robot enrol ROBOT --out FILE")


async def main(enrolment: str) -> None:
    frame = make_problem(seed=5)  # 200 matches of points and pixels, 30 % of them wrong
    async with connect(enrolment=enrolment) as robot:
        answer = await robot.solve_pnp(frame.points_world, frame.pixels, frame.camera, deadline_s=5.0)
    print(f"{answer.solution.verdict}: {len(answer.solution.inliers)} inliers, by {answer.server}")
    print(answer.solution.T_camera_world.round(3))


if __name__ == "__main__":
    try:
        asyncio.run(main(parser.parse_args().enrolment))
    except RsePfError as error:
        raise SystemExit(str(error)) from None
