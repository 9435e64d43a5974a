"""Run for days: the robot signs each of its short-lived tokens with a private key that never leaves it.

Once, on the robot:    rse-pf robot keygen --out robot.key > robot.json
Once, by the operator: rse-pf robot enrol ROBOT --public-key robot.json
"""

import argparse
import asyncio

from client_sdk import connect
from rse_pf.auth.robot_key import RobotKey
from rse_pf.config import AuthSettings
from rse_pf.errors import RsePfError
from rse_pf.pnp.problems import make_problem

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
parser.add_argument("url", help="ws://HOST:PORT/ws or wss://HOST/ws")
parser.add_argument("key", help="file of the private key")
parser.add_argument("robot", help="name under which the public key is enrolled")
parser.add_argument("--token-life", type=int, default=900, metavar="S", help="10 to 900 s (default: 900)")
parser.add_argument("--every", type=float, default=1.0, metavar="S", help="seconds between frames")


async def main(args: argparse.Namespace) -> None:
    key = RobotKey(args.key, args.robot, settings=AuthSettings(token_ttl_s=args.token_life))

    async def token() -> str:
        """Called for each connect, and before the current token expires; `key.token` alone does as well."""
        print("signed a token")
        return await key.token()

    frame = make_problem(seed=5)
    async with connect(args.url, token=token) as robot:
        while True:
            answer = await robot.solve_pnp(frame.points_world, frame.pixels, frame.camera, deadline_s=5.0)
            print(f"pose {robot.stats.answered} by {answer.server}, {robot.stats.reconnects} reconnects")
            await asyncio.sleep(args.every)


if __name__ == "__main__":
    try:
        asyncio.run(main(parser.parse_args()))
    except KeyboardInterrupt:
        pass
    except RsePfError as error:
        raise SystemExit(str(error)) from None
