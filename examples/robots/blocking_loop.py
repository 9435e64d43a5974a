"""Use poses in a control loop of fixed rate, without asyncio; a late answer is skipped."""

import argparse
import time

from client_sdk import connect_blocking
from rse_pf.errors import ConfigurationError, RsePfError
from rse_pf.pnp.problems import make_problem

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("enrolment", help="file of: rse-pf robot enrol ROBOT --out FILE")
parser.add_argument("--rate", type=float, default=10.0, help="turns of the loop per second (default: 10)")
parser.add_argument("--turns", type=int, default=50, help="end after so many turns (default: 50)")


def main(args: argparse.Namespace) -> None:
    period_s, missed = 1.0 / args.rate, 0
    with connect_blocking(enrolment=args.enrolment) as robot:
        next_s = time.monotonic()
        for turn in range(args.turns):
            frame = make_problem(seed=turn)  # here: matches of your camera's image
            try:
                answer = robot.solve_pnp(
                    frame.points_world, frame.pixels, frame.camera, deadline_s=0.8 * period_s
                )
                x, y, z = answer.solution.T_camera_world[:3, 3]
                print(f"turn {turn}: steer by {x:.2f} {y:.2f} {z:.2f} m, {answer.round_trip_ms:.1f} ms old")
            except ConfigurationError:
                raise
            except RsePfError as error:  # too late, too few matches, connection lost: keep the last command
                missed += 1
                print(f"turn {turn}: no pose ({error.code})")
            next_s += period_s
            time.sleep(max(0.0, next_s - time.monotonic()))
    print(f"{args.turns} turns, {missed} without a pose")


if __name__ == "__main__":
    try:
        main(parser.parse_args())
    except RsePfError as error:
        raise SystemExit(str(error)) from None
