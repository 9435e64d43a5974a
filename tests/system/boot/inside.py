"""What the outside world does from within the machine's network: fill the buckets, ask, read the numbers.

python inside.py fill FILE | keys TEXT | numbers | pose TOKEN URL | services TOKEN URL
"""

from __future__ import annotations

import json
import sys
from datetime import datetime, timedelta, timezone
from typing import Any

REGION, ASSETS, ARTIFACTS, AUDIT, MAPS = "ap-northeast-2", "assets", "artifacts", "audit", "maps"


def client(service: str) -> Any:
    import boto3

    return boto3.session.Session().client(
        service, region_name=REGION, aws_access_key_id="testing", aws_secret_access_key="testing",
        endpoint_url="https://127.0.0.2", verify=sys.argv[1],
    )  # fmt: skip


def fill(package: str) -> None:
    s3 = client("s3")
    for bucket in (ASSETS, ARTIFACTS, AUDIT, MAPS):
        s3.create_bucket(Bucket=bucket, CreateBucketConfiguration={"LocationConstraint": REGION})
    s3.upload_file(package, ASSETS, "package.zip")


def keys(text: str) -> None:
    client("s3").put_object(Bucket=ARTIFACTS, Key="keys.json", Body=text.encode())


def numbers() -> None:
    now = datetime.now(timezone.utc)
    found = client("cloudwatch").get_metric_statistics(
        Namespace="RsePf", MetricName="Requests", Period=3600, Statistics=["Sum", "SampleCount"],
        Dimensions=[{"Name": "AutoScalingGroupName", "Value": "rse-pf"}],
        StartTime=now - timedelta(hours=1), EndTime=now + timedelta(hours=1),
    )  # fmt: skip
    print(
        json.dumps({name: sum(each[name] for each in found["Datapoints"]) for name in ("Sum", "SampleCount")})
    )


def pose(token: str, url: str) -> None:
    import numpy as np

    from client_sdk import connect_blocking
    from rse_pf.errors import RsePfError
    from rse_pf.pnp.problems import make_problem

    problem = make_problem(seed=7, noise_px=0.5, outlier_ratio=0.3)
    try:
        with connect_blocking(url, token=token) as robot:
            answer = robot.solve_pnp(problem.points_world, problem.pixels, problem.camera)
    except RsePfError as error:
        print(json.dumps({"failed": error.code}))
        return
    off = float(np.abs(answer.solution.T_camera_world - problem.T_camera_world).max())
    print(json.dumps({"server": answer.server, "off": off, "verdict": str(answer.solution.verdict)}))


def services(token: str, url: str) -> None:
    """Print what each service of maps says: the name of what it found, or the code of its failure."""
    import numpy as np

    from client_sdk import connect_blocking
    from rse_pf.errors import RsePfError

    points = np.random.default_rng(5).uniform(-2.0, 2.0, (2000, 3))
    points[:700, 2], points[700:1400, 1] = -2.0, 2.0  # a floor, a wall and clutter
    graph = "".join(f"VERTEX_SE3:QUAT {i} {i} 0 0 0 0 0 1\n" for i in range(4))
    information = " ".join("1" if row == column else "0" for row in range(6) for column in range(row, 6))
    graph += "".join(f"EDGE_SE3:QUAT {i} {i + 1} 1.1 0 0 0 0 0 1 {information}\n" for i in range(3))
    requests: dict[str, dict[str, Any]] = {
        "icp": {
            "target": points.ravel().tolist(),
            "source": (points + np.array([0.02, 0.0, 0.01])).ravel().tolist(),
            "T_target_source": np.eye(4).ravel().tolist(),
        },
        "optimise": {"g2o": graph},
        "live-start": {"map": "a-live-map"},
    }  # fmt: skip
    said = {}
    with connect_blocking(url, token=token) as robot:
        for service, request in requests.items():
            try:
                said[service] = "" if robot.call(service, request, deadline_s=60.0).reply else "nothing"
            except RsePfError as error:
                said[service] = f"{error.code}: {error.message}"
    print(json.dumps(said))


if __name__ == "__main__":
    actions = {"fill": fill, "keys": keys, "numbers": numbers, "pose": pose, "services": services}
    actions[sys.argv[2]](*sys.argv[3:])
